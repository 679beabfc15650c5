//! What is advised, by what is known.

use super::*;

fn advice(guess: Guess) -> Advice {
    let mut state = State::new();
    state.take(&StationEvent::Phase { scan: 1, phase: Some(Phase::Drag) });
    state.take(&StationEvent::Guess(guess));
    state.advice
}

#[test]
fn lift_is_advised_only_once_the_drag_is_enough() {
    let guess =
        |settled, needed_s, enough| Guess { settled, needed_s, enough, ..Guess::nothing(1, 0.85) };
    let counting = advice(guess(false, Some(1.0), false));
    assert_eq!((counting.what, counting.text.as_str()), (AdviceKind::Drag, "0.2 s more"));
    assert_eq!(advice(guess(true, None, false)).what, AdviceKind::Drag, "no rule to rely on");
    assert_eq!(advice(guess(true, Some(3.0), true)).what, AdviceKind::Lift);
    assert_eq!(advice(guess(false, None, false)).text, "drag");
}

#[test]
fn a_guess_lasts_as_long_as_its_scan() {
    let mut state = State::new();
    let phase = |scan, phase| StationEvent::Phase { scan, phase };
    let guess = |scan| StationEvent::Guess(Guess::nothing(scan, 0.5));
    state.take(&phase(1, Some(Phase::Drag)));
    state.take(&guess(1));
    assert_eq!(state.guess.as_ref().map(|guess| guess.scan), Some(1));
    state.take(&phase(1, None));
    assert_eq!(state.guess, None);
    // The worker was still at it; then the next scan begins.
    state.take(&guess(1));
    assert_eq!(state.guess, None);
    state.take(&phase(2, Some(Phase::Tap)));
    state.take(&guess(1));
    assert_eq!(state.guess, None);
}
