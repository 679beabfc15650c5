use std::collections::BTreeMap;
use std::fs;
use std::sync::Arc;

use super::*;
use crate::recognise::RankedSurface;
use crate::scan::Scan;
use crate::scene::Scene;
use crate::station::{AnsweredScan, Listener, StationEvent};
use crate::trial::{Doubt, Series, Signal};

pub(super) fn answer(scan: u32, surface: Option<&str>) -> Answer {
    let id = format!("20260921-143000.{scan:03}-{scan:02}");
    Answer {
        link: format!("/#scan={id}"),
        id,
        unix_ms: 1_790_001_000_000 + u64::from(scan),
        surface: surface.map(Into::into),
        state: if surface.is_some() { AnswerState::Named } else { AnswerState::Unknown },
        ranked: vec![RankedSurface { surface: "oak".into(), score: 1.0 }],
        ..Answer::of(&Scan::of_signals(scan, BTreeMap::new()), 1.0)
    }
}

impl From<Truth> for Correction {
    fn from(truth: Truth) -> Self {
        Self { truth, person: Some("anna".into()) }
    }
}

fn was(surface: &str) -> Correction {
    Truth::Surface { surface: surface.into() }.into()
}

/// Adds an answer, and writes `bytes` bytes of signals for it.
fn keep(history: &History, scan: u32, bytes: usize) -> String {
    let answer = answer(scan, Some("oak"));
    history.answered(&answer).unwrap();
    let folder = history.root().unwrap().join(SCANS).join(&answer.id);
    fs::create_dir_all(&folder).unwrap();
    fs::write(folder.join("ir.wav"), vec![0; bytes]).unwrap();
    history.kept(&answer.id).unwrap();
    answer.id
}

fn scans(history: &History) -> Vec<u32> {
    let rows = history.newest(None, 1000, &Wanted::default()).unwrap();
    rows.iter().map(|row| row.head.scan).collect()
}

#[test]
fn what_was_answered_kept_and_corrected_is_there_after_a_restart() {
    let dir = tempfile::tempdir().unwrap();
    let was = was("ash");
    let id = {
        let history = History::open(dir.path(), 1 << 20).unwrap();
        let id = keep(&history, 1, 100);
        history.answered(&answer(2, None)).unwrap();
        history.correct(&id, Some(was.clone())).unwrap();
        history.became(&id, Some("ash/anna-01".into()), Some("ben".into())).unwrap();
        assert!(matches!(History::open(dir.path(), 1), Err(HistoryError::InUse(_))));
        id
    };
    // A crash cut the last line short, and left a folder that is unfinished.
    let log = dir.path().join("answers.jsonl");
    fs::write(&log, fs::read_to_string(&log).unwrap() + "{\"answer\":{\"id\":\"x").unwrap();
    fs::create_dir(dir.path().join("scans/.stray.unfinished")).unwrap();
    let history = History::open(dir.path(), 1 << 20).unwrap();
    assert_eq!(scans(&history), [2, 1]);
    let first = history.answer("1").unwrap();
    assert_eq!((&first.head.id, &first.correction), (&id, &Some(was)));
    assert_eq!((first.became.as_deref(), first.kept), (Some("ash/anna-01"), true));
    assert_eq!(first.became_by.as_deref(), Some("ben"));
    let json = serde_json::to_value(&first).unwrap();
    assert_eq!(
        (&json["correction"]["was"], &json["link"]),
        (&"surface".into(), &format!("/#scan={id}").into())
    );
    assert!(history.folder(&id).unwrap().join("ir.wav").exists());
    assert!(matches!(history.folder("2"), Err(HistoryError::NoSignals(_))));
    assert!(matches!(history.answer("3"), Err(HistoryError::NoScan(_))));
    assert!(!dir.path().join("scans/.stray.unfinished").exists());
    history.answered(&answer(3, None)).unwrap();
    assert_eq!(scans(&history), [3, 2, 1], "the line that was cut short spoils no other");
    assert_eq!(history.precision()[0].corrected, 1);
}

#[test]
fn a_scan_without_a_name_is_kept_with_its_reason_and_its_signals() {
    let dir = tempfile::tempdir().unwrap();
    let history = Arc::new(History::open(dir.path(), 1 << 20).unwrap());
    let mut keeper =
        Keeper::start(history.clone(), Scene::lmt108(), BTreeMap::new(), None).unwrap();
    let silence = Signal::Series(Series::new(10_000.0, 1, vec![0.0; 100]).unwrap());
    for (number, signals) in
        [(1, BTreeMap::from([(SourceId::new("ir").unwrap(), silence)])), (2, BTreeMap::new())]
    {
        let scan = Scan { scan_s: 0.01, ..Scan::of_signals(number, signals) };
        let unnamed = Answer {
            state: AnswerState::Unnamed,
            doubts: vec![Doubt::NotNamed { why: "too little to name".into() }],
            ranked: Vec::new(),
            ..answer(number, None)
        };
        let whole = AnsweredScan { scan: Box::new(scan), answer: Arc::new(unnamed), by: None };
        keeper.on_event(&StationEvent::Scan(Arc::new(whole)));
    }
    drop(keeper);
    assert_eq!(scans(&history), [2, 1]);
    for (name, kept) in [("1", true), ("2", false)] {
        let row = history.answer(name).unwrap();
        assert_eq!((row.head.state, row.kept), (AnswerState::Unnamed, kept));
        assert_eq!(row.reasons[0], "too little to name");
    }
    assert!(history.folder("1").unwrap().join("ir.wav").exists());
    assert_eq!(history.extent().problem, None);
    history.correct(&answer(1, None).id, Some(Truth::Unknown.into())).unwrap();
    assert_eq!(history.precision(), [], "it was no answer");
}

#[test]
fn only_what_is_asked_for_is_given_by_page_and_as_a_whole() {
    let history = History::default();
    for scan in 1..=9 {
        let answer = answer(scan, [Some("oak"), Some("ash"), None][scan as usize % 3]);
        let user = [None, Some("anna".to_string())][usize::from(scan > 5)].clone();
        history.answered(&Answer { user, ..answer }).unwrap();
    }
    let first = history.answer("3").unwrap().head;
    history.correct(&first.id, Some(was("elm"))).unwrap();
    let at = |scan: u64| Some(first.unix_ms - 3 + scan);
    let text = |text: &str| Some(text.to_string());
    for (wanted, scans) in [
        (Wanted::default(), vec![9, 8, 7, 6, 5, 4, 3, 2, 1]),
        (Wanted { states: vec![AnswerState::Unknown], ..Wanted::default() }, vec![8, 5, 2]),
        (Wanted { surface: text("ash"), ..Wanted::default() }, vec![7, 4, 1]),
        (Wanted { surface: text("elm"), ..Wanted::default() }, vec![3]),
        (Wanted { from_unix_ms: at(4), to_unix_ms: at(6), ..Wanted::default() }, vec![6, 5, 4]),
        (Wanted { user: text("anna"), surface: text("oak"), ..Wanted::default() }, vec![9, 6]),
        (Wanted { user: text("ann"), ..Wanted::default() }, vec![]),
        (Wanted { text: text("ELM"), ..Wanted::default() }, vec![3]),
        (Wanted { surface: text("oak"), to_unix_ms: at(5), ..Wanted::default() }, vec![3]),
    ] {
        let numbers =
            |rows: Vec<HistoryRow>| rows.iter().map(|row| row.head.scan).collect::<Vec<_>>();
        assert_eq!(numbers(history.newest(None, 99, &wanted).unwrap()), scans, "{wanted:?}");
        let older = history.newest(Some(&first.id), 99, &wanted).unwrap();
        assert!(numbers(older).iter().all(|scan| *scan < 3 && scans.contains(scan)));
        let whole: Vec<HistoryRow> = history.rows(wanted).map(Result::unwrap).collect();
        assert_eq!(numbers(whole).into_iter().rev().collect::<Vec<_>>(), scans);
    }
}

#[test]
fn the_oldest_signals_make_room_and_their_answers_stay() {
    let dir = tempfile::tempdir().unwrap();
    let history = History::open(dir.path(), 80_000).unwrap();
    let ids: Vec<String> = (1..=10).map(|scan| keep(&history, scan, 20_000)).collect();
    let kept = || ids.iter().filter(|id| history.folder(id).is_ok()).collect::<Vec<_>>();
    assert_eq!(kept(), [&ids[7], &ids[8], &ids[9]]);
    let on_disk = fs::read_dir(dir.path().join(SCANS)).unwrap().count();
    assert_eq!((on_disk, scans(&history).len()), (3, 10));
    assert!(history.extent().bytes <= 80_000);
    // As on a disk that is nearly full.
    lock(&history.inner).let_go(20_001).unwrap();
    assert_eq!(kept(), [&ids[9]]);
    lock(&history.inner).let_go(1 << 20).unwrap();
    assert_eq!((kept().len(), scans(&history).len()), (0, 10));
    // Signals that find no room at all are a problem, which is said.
    let answer = answer(11, Some("oak"));
    history.answered(&answer).unwrap();
    let folder = dir.path().join(SCANS).join(&answer.id);
    fs::create_dir_all(&folder).unwrap();
    fs::write(folder.join("ir.wav"), vec![0; 90_000]).unwrap();
    history.note(history.kept(&answer.id));
    let problem = history.extent().problem.unwrap();
    assert!(!folder.exists() && problem.starts_with("there is no room"), "{problem}");
}

#[test]
fn the_log_is_bounded_and_keeps_the_newest_answers_with_what_was_said_of_them() {
    let dir = tempfile::tempdir().unwrap();
    let most = 400_000;
    let history = History::open(dir.path(), most).unwrap();
    for scan in 1..=1000 {
        let answer = answer(scan, Some("oak"));
        history.answered(&answer).unwrap();
        history.correct(&answer.id, Some(Truth::Unknown.into())).unwrap();
        // Each second one was a trial, and is none any more.
        let trial = (scan % 2 == 0).then(|| format!("oak/anna-{scan}"));
        history.became(&answer.id, trial, Some("ben".into())).unwrap();
    }
    let log = fs::metadata(dir.path().join("answers.jsonl")).unwrap().len();
    assert!(log <= most / 8 + 2000, "{log}");
    let newest = history.newest(None, 1000, &Wanted::default()).unwrap();
    assert!(newest.len() > 20 && newest.len() < 1000);
    assert_eq!(newest[0].head.scan, 1000);
    assert!(newest.iter().all(|row| row.correction == Some(Truth::Unknown.into())));
    let trials: Vec<bool> = newest.iter().map(|row| row.became.is_some()).collect();
    assert_eq!(trials[..4], [true, false, true, false]);
    assert!(newest.iter().all(|row| row.became_by.as_deref() == Some("ben")));
    let before = &newest[5].head.id;
    assert_eq!(history.newest(Some(before), 1, &Wanted::default()).unwrap()[0].head.scan, 994);
}

#[test]
fn answers_are_read_from_the_old_log_if_a_shorter_one_cannot_take_its_place() {
    let dir = tempfile::tempdir().unwrap();
    let history = History::open(dir.path(), 400_000).unwrap();
    let written = (1..=1000).map(|scan| {
        if scan == 60 {
            // A folder with the name of the log, which no file can replace.
            fs::remove_file(dir.path().join("answers.jsonl")).unwrap();
            fs::create_dir(dir.path().join("answers.jsonl")).unwrap();
        }
        history.answered(&answer(scan, Some("oak")))
    });
    assert_eq!(written.skip_while(Result::is_ok).take(3).count(), 3, "the log was never too long");
    for row in history.newest(None, 1000, &Wanted::default()).unwrap() {
        assert_eq!(row.others["link"], format!("/#scan={}", row.head.id));
    }
}

#[test]
fn numbers_are_read_to_their_last_digit() {
    let history = History::default();
    for scan in 1..=500 {
        let margin = f64::from(scan).sqrt() / 7.0;
        let answer = Answer { margin, ..answer(scan, Some("oak")) };
        history.answered(&answer).unwrap();
        assert_eq!(history.answer(&answer.id).unwrap().others["margin"], margin);
    }
}

#[test]
fn a_history_in_memory_remembers_a_thousand_answers() {
    let history = History::default();
    (1..=1200).for_each(|scan| history.answered(&answer(scan, None)).unwrap());
    assert_eq!((scans(&history).len(), scans(&history)[0]), (1000, 1200));
    history.correct(&answer(1200, None).id, Some(Truth::Bad.into())).unwrap();
    assert_eq!(history.answer("1200").unwrap().correction, Some(Truth::Bad.into()));
}

#[test]
fn signals_that_a_damaged_log_does_not_know_are_set_aside_and_files_of_others_left_alone() {
    let dir = tempfile::tempdir().unwrap();
    let ids = {
        let history = History::open(dir.path(), 1 << 20).unwrap();
        [1, 2, 3].map(|scan| keep(&history, scan, 100))
    };
    let log = dir.path().join("answers.jsonl");
    let text = fs::read_to_string(&log).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    // Left out: the first scan, and the line about the second one's signals. Added: an id that
    // leads out of the folder, and a line too long to be read.
    let evil = lines[0].replace(&ids[0], "../../oak/anna-01");
    let long = "x".repeat(3 << 20);
    fs::write(&log, [lines[2], &evil, &long, lines[4], lines[5]].join("\n") + "\n").unwrap();
    fs::write(dir.path().join("scans/.DS_Store"), "").unwrap();
    let history = History::open(dir.path(), 1 << 26).unwrap();
    assert_eq!(scans(&history), [3, 2]);
    assert!(history.folder(&ids[1]).unwrap().join("ir.wav").exists());
    assert!(dir.path().join("aside").join(&ids[0]).join("ir.wav").exists());
    assert!(dir.path().join("scans/.DS_Store").exists());
    drop(history);
    // Without a log, all are set aside.
    fs::remove_file(&log).unwrap();
    drop(History::open(dir.path(), 1 << 20).unwrap());
    assert_eq!(fs::read_dir(dir.path().join("aside")).unwrap().count(), 3);
}

#[test]
fn a_log_that_is_no_file_is_refused_and_of_a_long_one_only_the_end_is_read() {
    let dir = tempfile::tempdir().unwrap();
    let log = dir.path().join("answers.jsonl");
    rustix::fs::mkfifoat(rustix::fs::CWD, &log, rustix::fs::Mode::RWXU).unwrap();
    for opened in [History::open(dir.path(), 1 << 20), History::read(dir.path())] {
        assert!(opened.unwrap_err().to_string().contains("not a regular file"));
    }
    fs::remove_file(&log).unwrap();
    // A sparse file of 3 GiB, of which only the end is read.
    fs::File::create(&log).unwrap().set_len(3 << 30).unwrap();
    let history = History::open(dir.path(), 1 << 20).unwrap();
    keep(&history, 1, 100);
    assert!(fs::metadata(&log).unwrap().len() < 1 << 20);
    assert_eq!(scans(&history), [1]);
}

#[test]
fn precision_counts_by_what_was_answered_and_not_bad_scans() {
    let said = [
        (Some("oak"), was("oak")),
        (Some("oak"), was("ash")),
        (Some("oak"), Truth::Unknown.into()),
        (Some("oak"), Truth::Bad.into()),
        (None, Truth::Unknown.into()),
        (None, was("elm")),
    ];
    let found = precision(said.iter().map(|(answered, was)| (*answered, was)));
    let counts: Vec<_> =
        found.iter().map(|p| (p.surface.as_deref(), p.right, p.corrected)).collect();
    assert_eq!(counts, [(None, 1, 2), (Some("oak"), 1, 3)]);
}
