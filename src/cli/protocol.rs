//! The protocols by which queries and library are split, as arguments.

use clap::ValueEnum;
use clap::builder::PossibleValue;

use crate::evaluate::Protocol;

/// A protocol on the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ProtocolArg(pub Protocol);

impl ValueEnum for ProtocolArg {
    fn value_variants<'a>() -> &'a [Self] {
        &const {
            let [a, b, c, d] = Protocol::ALL;
            [Self(a), Self(b), Self(c), Self(d)]
        }
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        let help = match self.0 {
            Protocol::ExpertVsUsers => {
                "The expert's trials are the library; each other user is a fold of queries (1 vs 10)"
            }
            Protocol::LeaveOneTrialOut => {
                "Fold k: trial k of every surface against the same person's other trials (1 vs 1)"
            }
            Protocol::AllVsOneUser => {
                "Each user is a fold; the library is everybody else (10 vs 1)"
            }
            Protocol::RandomHalves => {
                "50 folds: a random half of a person's trials of each surface against the other half"
            }
        };
        Some(PossibleValue::new(self.0.name()).help(help))
    }
}
