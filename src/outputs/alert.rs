//! Alerts: answers, and drifts, that somebody must hear of at once, by rules; and the coil of a Modbus
//! device that an alert switches.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use serde::Serialize;
use tokio::net::TcpStream;
use tokio::sync::mpsc;
use tokio::time::{Instant, sleep, timeout};
use tokio_modbus::client::{Context, Reader, Writer, tcp};
use tokio_modbus::slave::Slave;

use super::{BackOff, OutputHealth, Said, Sent, every, within};
use crate::history::{History, news};
use crate::station::config::{AlertCause, AlertConfig, CoilAddress};
use crate::station::{Answer, AnswerState};
use crate::trial::{Doubt, unix_ms};

/// How long one attempt to switch a coil may take.
const ATTEMPT: Duration = Duration::from_secs(3);
/// How long after an alert its coil may still be switched on: later, the part is gone.
const LATEST: Duration = Duration::from_secs(10);
/// Interval at which the history is asked for drift.
const DRIFT_EVERY: Duration = Duration::from_secs(1);

#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Alert {
    pub alert: String,
    /// When the answer was given that made it, or the drift was found, in milliseconds since 1970.
    pub unix_ms: u64,
    #[serde(flatten)]
    why: Reason,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
enum Reason {
    Answers {
        /// How many of the last `of` answers fit the rule.
        scans: usize,
        of: usize,
        /// The newest of these answers.
        id: String,
        link: String,
        state: AnswerState,
        surface: Option<String>,
    },
    Drift {
        /// All that has drifted by now.
        drift: Vec<Doubt>,
    },
}

/// A rule, and what it has heard.
#[derive(Debug)]
pub(super) struct Watch {
    pub rule: AlertConfig,
    /// Whether each of the last answers fits the rule, the newest last.
    heard: VecDeque<bool>,
    /// The drift that the last alert reported, as far as it has not ended since.
    drifted: Vec<Doubt>,
    quiet_until_ms: u64,
}

impl Watch {
    pub(super) fn new(rule: &AlertConfig) -> Self {
        let (heard, drifted) = (VecDeque::new(), Vec::new());
        Self { rule: rule.clone(), heard, drifted, quiet_until_ms: 0 }
    }

    /// Hears an answer; gives an alert if the answer fits the rule, as enough of the last ones do, and no
    /// alert came within the cooldown.
    pub(super) fn hears(&mut self, answer: &Answer) -> Option<Arc<Alert>> {
        let fits = match &self.rule.on {
            AlertCause::State(state) => answer.state == *state,
            AlertCause::Surface(surface) => answer.surface.as_ref() == Some(surface),
            AlertCause::Drift => return None,
        };
        self.heard.push_back(fits);
        if self.heard.len() > self.rule.of {
            self.heard.pop_front();
        }
        let scans = self.heard.iter().filter(|fits| **fits).count();
        if !fits || scans < self.rule.scans || answer.unix_ms < self.quiet_until_ms {
            return None;
        }
        let (id, link, surface) = (answer.id.clone(), answer.link.clone(), answer.surface.clone());
        let (of, state) = (self.rule.of, answer.state);
        Some(self.alert(answer.unix_ms, Reason::Answers { scans, of, id, link, state, surface }))
    }

    /// Sees what has drifted by now; gives an alert if something has that the last one did not say. What
    /// begins within the cooldown is said at its end, since a drift lasts.
    fn sees(&mut self, drift: &[Doubt], unix_ms: u64) -> Option<Arc<Alert>> {
        let ended: Vec<Doubt> = news(drift, &self.drifted).cloned().collect();
        self.drifted.retain(|doubt| !ended.contains(doubt));
        if unix_ms < self.quiet_until_ms || news(&self.drifted, drift).next().is_none() {
            return None;
        }
        self.drifted = drift.to_vec();
        Some(self.alert(unix_ms, Reason::Drift { drift: drift.to_vec() }))
    }

    fn alert(&mut self, unix_ms: u64, why: Reason) -> Arc<Alert> {
        let cooldown = u64::try_from(self.rule.cooldown.as_millis()).unwrap_or(u64::MAX);
        self.quiet_until_ms = unix_ms.saturating_add(cooldown);
        Arc::new(Alert { alert: self.rule.name.clone(), unix_ms, why })
    }
}

/// Says the drift that the scans of a history show, until the station ends. Scans are added to the history
/// on threads of its own, so no event of the station tells when the drift has changed.
pub(super) async fn watch_drift(
    history: Arc<History>,
    mut watches: Vec<Watch>,
    said: mpsc::WeakSender<Said>,
) {
    let mut due = every(DRIFT_EVERY);
    loop {
        due.tick().await;
        let (drift, now) = (history.drift(), unix_ms(SystemTime::now()));
        let Some(said) = said.upgrade() else { return };
        for alert in watches.iter_mut().filter_map(|watch| watch.sees(&drift.doubts, now)) {
            if said.send(Said::Alert(alert)).await.is_err() {
                return;
            }
        }
    }
}

/// Switches the coil on with each alert, and off once `hold` has passed since the last. At the end of the
/// station it is switched off at once.
pub(super) async fn switch_all(
    health: OutputHealth,
    coil: CoilAddress,
    hold: Duration,
    mut alerts: mpsc::Receiver<Said>,
) {
    while alerts.recv().await.is_some() {
        if !switched_on(&health, &coil).await {
            continue;
        }
        // Another alert holds the coil for longer.
        while let Ok(Some(_)) = timeout(hold, alerts.recv()).await {}
        // A coil must not stay on, so this is tried until it succeeds or nobody waits any more.
        let mut back_off = BackOff::new();
        while let Err(why) = switch(&coil, false).await {
            health.failed(&format!("it is still on: {why}; tried again"));
            if alerts.is_closed() {
                return;
            }
            sleep(back_off.next()).await;
        }
        health.arrived();
    }
}

async fn switched_on(health: &OutputHealth, coil: &CoilAddress) -> bool {
    let (until, mut back_off) = (Instant::now() + LATEST, BackOff::new());
    loop {
        match switch(coil, true).await {
            Ok(()) => {
                health.arrived();
                return true;
            }
            Err(why) => health.failed(&format!("not switched on: {why}")),
        }
        let pause = back_off.next();
        if Instant::now() + pause > until {
            return false;
        }
        sleep(pause).await;
    }
}

async fn switch(coil: &CoilAddress, on: bool) -> Sent<()> {
    let write = async |mut device: Context| device.write_single_coil(coil.coil, on).await;
    reached(coil, write).await
}

/// Whether the coil is on now; switches nothing.
pub(super) async fn read(coil: &CoilAddress) -> Sent<bool> {
    let read = async |mut device: Context| device.read_coils(coil.coil, 1).await;
    Ok(*reached(coil, read).await?.first().ok_or("it gave no coil")?)
}

/// Connects to the coil's device, and does `work` there.
async fn reached<T>(
    coil: &CoilAddress,
    work: impl AsyncFnOnce(Context) -> tokio_modbus::Result<T>,
) -> Sent<T> {
    let (host, port) = &coil.host;
    let reached = async {
        let stream = TcpStream::connect((host.as_str(), *port)).await?;
        // The device may be reached, and refuse.
        Ok(work(tcp::attach_slave(stream, Slave(coil.unit))).await??)
    };
    within(ATTEMPT, reached).await
}

#[cfg(test)]
mod tests {
    use super::*;

    fn watch(on: AlertCause, (scans, of): (usize, usize), cooldown_s: u64) -> Watch {
        let cooldown = Duration::from_secs(cooldown_s);
        let (name, http, coil, hold) = ("reject".into(), None, None, Duration::ZERO);
        Watch::new(&AlertConfig { name, on, scans, of, cooldown, http, coil, hold })
    }

    /// The seconds at which a rule gives alerts, of answers a second apart.
    fn alerts(watch: &mut Watch, answers: &str) -> Vec<u64> {
        let states = answers.chars().map(|letter| match letter {
            'u' => (AnswerState::Unknown, None),
            '?' => (AnswerState::Unsure, Some("oak")),
            _ => (AnswerState::Named, Some("oak")),
        });
        let answers = (0..).zip(states).map(|(second, (state, surface))| Answer {
            unix_ms: 1000 * second,
            state,
            surface: surface.map(String::from),
            ..Answer::default()
        });
        let alerts = answers.filter_map(|answer| watch.hears(&answer));
        alerts.map(|alert| alert.unix_ms / 1000).collect()
    }

    #[test]
    fn an_alert_comes_when_enough_of_the_last_answers_fit_and_not_within_the_cooldown() {
        let unknown = || AlertCause::State(AnswerState::Unknown);
        assert_eq!(alerts(&mut watch(unknown(), (1, 1), 0), "..u.uu"), [2, 4, 5]);
        assert_eq!(alerts(&mut watch(unknown(), (2, 3), 0), "u..u.u...uu"), [5, 10]);
        assert_eq!(alerts(&mut watch(unknown(), (2, 2), 3), "uuuuuuu"), [1, 4]);
        let oak = || AlertCause::Surface("oak".into());
        assert_eq!(alerts(&mut watch(oak(), (1, 1), 0), "u?u."), [1, 3]);
    }

    #[test]
    fn a_drift_is_said_once_until_it_ends_and_a_second_one_at_the_end_of_the_cooldown() {
        let of = |surface: char, moved: f64| Doubt::FitDrift {
            surface: surface.into(),
            moved,
            limit: 0.1,
        };
        let mut watch = watch(AlertCause::Drift, (1, 1), 2);
        // The charts that have drifted, second by second; the numbers change with each scan.
        let seen = ["", "o", "o", "o", "oa", "oa", "oa", "", "a", "oa"];
        let said: Vec<(u64, usize)> = (0..)
            .zip(seen)
            .filter_map(|(second, surfaces)| {
                let drift: Vec<_> =
                    surfaces.chars().map(|letter| of(letter, -0.2 - second as f64)).collect();
                let alert = watch.sees(&drift, 1000 * second)?;
                let Reason::Drift { drift } = &alert.why else { panic!("{alert:?}") };
                Some((second, drift.len()))
            })
            .collect();
        assert_eq!(said, [(1, 1), (4, 2), (8, 1)]);
        assert_eq!(watch.hears(&Answer::default()), None, "answers are not its business");
    }
}
