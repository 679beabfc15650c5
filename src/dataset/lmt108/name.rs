//! Parses the path of a file in LMT108: tells the trial, the source and the channel that it holds.
//!
//! Some of the database's names are inferred (method.md §7), so parsing is lenient: case does not
//! matter, and a name need not repeat its folders' names.

use crate::trial::{EXPERT, TrialKey};

/// The trial, source and channel that a file holds.
#[derive(Debug, PartialEq)]
pub(super) struct NamePart {
    pub key: TrialKey,
    pub source: &'static str,
    /// Index of the channel, from 0; 0 if the file holds all channels of the source.
    pub channel: usize,
    /// Whether folder and file name disagree about the split: training or test.
    pub contradicts: bool,
}

/// Words that may follow the surface in a file's name.
const WORDS: [&str; 12] = [
    "movement",
    "tapping",
    "sound",
    "image",
    "reflectance",
    "metaldetection",
    "metal",
    "friction",
    "frictionfsr1",
    "frictionfsr2",
    "fsr1",
    "fsr2",
];

/// Parses a file's name: `folders` holds the folders from the database's root down to the file, in
/// lower case, `stem` the name without its extension. The error says why no trial has the file.
pub(super) fn parse(folders: &[String], stem: &str) -> Result<NamePart, &'static str> {
    let in_folder = |name: &str| folders.iter().any(|folder| folder == name);
    let said = is_training(folders);
    let (rest, by_name, number) = cut_number(stem)?;
    let is_training =
        said.or(by_name).ok_or("neither its folder nor its name says train or test")?;
    let contradicts = by_name.is_some_and(|name| name != is_training);

    let mut parts: Vec<&str> = rest.split('_').filter(|part| !part.is_empty()).collect();
    let mut flash = in_folder("flash");
    if parts.first().is_some_and(|first| is(first, &["flash", "noflash"])) {
        flash |= is(parts.remove(0), &["flash"]);
    }
    let words_at = parts.iter().skip(1).position(|part| is(part, &WORDS)).map(|at| at + 1);
    let (surface, words) = parts.split_at(words_at.ok_or("its name does not say what it is")?);
    let words: Vec<String> = words.iter().map(|word| word.to_ascii_lowercase()).collect();
    let has = |word: &str| words.iter().any(|w| w == word);
    let tap = has("tapping") || !has("movement") && in_folder("tapping");

    let mut trial = number;
    let (source, channel) = if has("image") {
        // Image names hold two numbers: (1, 1), (10, 2), (2, 3), …. The first is the trial.
        if let Some(number) = words.last().and_then(|word| word.parse().ok()) {
            trial = number;
        }
        (if flash { "ca2" } else { "ca1" }, 0)
    } else if has("sound") || in_folder("soundscans") {
        (if tap { "mi1" } else { "mi2" }, 0)
    } else if words.iter().any(|word| word.ends_with("fsr1")) || in_folder("fsr1") {
        ("fr", 0)
    } else if words.iter().any(|word| word.ends_with("fsr2")) || in_folder("fsr2") {
        ("fr", 1)
    } else if has("reflectance") {
        ("ir", 0)
    } else if has("metaldetection") || has("metal") {
        ("me", 0)
    } else if has("friction") {
        return Err("its name does not say which of the two force sensors it is");
    } else {
        let axis =
            words.last().and_then(|word| ["x", "y", "z"].iter().position(|axis| axis == word));
        match (tap, axis) {
            (true, Some(2)) => ("act", 0),
            (true, _) => return Err("of the tapping acceleration only axis Z is known"),
            (false, Some(axis)) => ("ac", axis),
            (false, None) => return Err("its name does not say which axis it is"),
        }
    };
    let user = if is_training { EXPERT.to_string() } else { format!("user{trial}") };
    Ok(NamePart {
        key: TrialKey::new(surface.join("_"), user, trial),
        source,
        channel,
        contradicts,
    })
}

fn is(part: &str, words: &[&str]) -> bool {
    words.iter().any(|word| part.eq_ignore_ascii_case(word))
}

/// The folder names of the two splits, each with true for training and false for test.
const SPLITS: [(&str, bool); 4] =
    [("training", true), ("train", true), ("testing", false), ("test", false)];

fn is_training(folders: &[String]) -> Option<bool> {
    let named = |folder: &String| SPLITS.iter().find(|(name, _)| folder == name);
    folders.iter().rev().find_map(named).map(|(_, is_training)| *is_training)
}

/// Cuts a suffix such as `_train7` off a name. Returns the text before the suffix, the split (true
/// for training, false for test, `None` if not given), and the number.
fn cut_number(stem: &str) -> Result<(&str, Option<bool>, u32), &'static str> {
    let head = stem.trim_end_matches(|c: char| c.is_ascii_digit());
    let number = stem[head.len()..].parse().map_err(|_| "its name does not end with a number")?;
    let head = head.trim_end_matches('_');
    for (word, is_training) in SPLITS {
        let at = head.len().wrapping_sub(word.len());
        if head.get(at..).is_some_and(|end| end.eq_ignore_ascii_case(word)) {
            return Ok((head[..at].trim_end_matches('_'), Some(is_training), number));
        }
    }
    Ok((head, None, number))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Key, source and channel of the file at `path`, as one line of text.
    fn parsed(path: &str) -> Result<String, &'static str> {
        let mut folders: Vec<String> = path.split('/').map(str::to_ascii_lowercase).collect();
        folders.pop();
        let stem = path.rsplit('/').next().unwrap().rsplit_once('.').unwrap().0;
        let NamePart { key: TrialKey { surface, user, number }, source, channel, .. } =
            parse(&folders, stem)?;
        Ok(format!("{surface} {user} {number} {source} {channel}"))
    }

    #[track_caller]
    fn expect(table: &str) {
        for line in table.lines().map(str::trim).filter(|line| !line.is_empty()) {
            let (path, expected) = line.split_once(' ').unwrap();
            assert_eq!(parsed(path).as_deref(), Ok(expected.trim()), "{path}");
        }
    }

    #[test]
    fn every_name_of_the_database_is_understood() {
        expect(
            "
            AccelScansComponents/Movement/Training/G1Mesh_Movement_Y_train7.txt G1Mesh expert 7 ac 1
            AccelScansComponents/Tapping/Training/G1Mesh_Tapping_Z_train10.txt G1Mesh expert 10 act 0
            SoundScans/Movement/Testing/G1Mesh_Sound_Movement_test2.wav G1Mesh user2 2 mi2 0
            SoundScans/Tapping/Training/G1Mesh_Sound_Tapping_train2.wav G1Mesh expert 2 mi1 0
            FricScans/FSR1/Training/G1Mesh_FrictionFSR1_Movement_train1.txt G1Mesh expert 1 fr 0
            FricScans/FSR2/Testing/G1Mesh_FrictionFSR2_Movement_test1.txt G1Mesh user1 1 fr 1
            ReflectanceScans/Training/G1Mesh_Reflectance_Movement_train3.txt G1Mesh expert 3 ir 0
            MetalDetectionScans/Testing/G1Mesh_MetalDetection_Movement_test3.txt G1Mesh user3 3 me 0
            ",
        );
        // The first number of an image is its trial.
        expect(
            "
            ImageScans/NoFlash/Training/G1Mesh_Image_1_train1.jpg G1Mesh expert 1 ca1 0
            ImageScans/NoFlash/Training/G1Mesh_Image_10_train2.jpg G1Mesh expert 10 ca1 0
            ImageScans/NoFlash/Testing/G1Mesh_Image_9_test0.jpg G1Mesh user9 9 ca1 0
            ImageScans/Flash/Training/Flash_G1Mesh_Image_2_train3.jpg G1Mesh expert 2 ca2 0
            ImageScans/Flash/Training/G1Mesh_Image_2_train3.jpg G1Mesh expert 2 ca2 0
            ",
        );
        // Case and missing words do not matter.
        expect(
            "
            soundscans/g4Oak_sound_movement_TRAIN3.WAV g4Oak expert 3 mi2 0
            SoundScans/Tapping/Training/G4Oak_Sound_3.wav G4Oak expert 3 mi1 0
            FricScans/FSR2/Testing/G4Oak_Friction_Movement_test4.txt G4Oak user4 4 fr 1
            MetalDetectionScans/Testing/G4Oak_Metal_Movement_test4.txt G4Oak user4 4 me 0
            ",
        );
    }

    #[test]
    fn the_folder_wins_over_the_name() {
        let folders = ["soundscans".to_string(), "testing".to_string()];
        let part = parse(&folders, "G1Mesh_Sound_Movement_train3").unwrap();
        assert_eq!((part.key.user.as_str(), part.contradicts), ("user3", true));
    }

    #[test]
    fn what_is_not_understood_says_why() {
        for (path, why) in [
            ("SoundScans/Movement/Training/readme.txt", "number"),
            ("SoundScans/G1Mesh_Sound_Movement_3.wav", "train or test"),
            ("FricScans/Training/G1Mesh_Friction_Movement_1.txt", "which"),
        ] {
            assert!(parsed(path).unwrap_err().contains(why), "{path}");
        }
    }

    proptest::proptest! {
        #[test]
        fn no_name_is_too_odd(stem in "\\PC{0,40}|[a-zA-Z_0-9ä]{0,30}") {
            let _ = parse(&["training".to_string()], &stem);
        }
    }
}
