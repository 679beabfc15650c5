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
