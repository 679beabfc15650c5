//! Conditions on trials, such as `force_n>=1`: the option `--where` of the commands that read a library.

use std::cmp::Ordering;
use std::collections::BTreeSet;
use std::path::Path;

use toml::Value;

use super::show::{counted, listed};
use super::{Done, Failure, show};
use crate::library::{Entry, Library};
use crate::trial::normal;

type IsMet = fn(Ordering) -> bool;

/// The comparisons, the longer ones first, so that `<=` is not read as `<`.
const OPERATORS: [(&str, IsMet); 6] = [
    ("!=", Ordering::is_ne),
    ("<=", Ordering::is_le),
    (">=", Ordering::is_ge),
    ("=", Ordering::is_eq),
    ("<", Ordering::is_lt),
    (">", Ordering::is_gt),
];

#[derive(Clone, Debug, Default, clap::Args)]
pub(super) struct WhereArgs {
    /// Use only trials for which this holds, such as user=anna, session=monday, or a key under [meta] of
    /// trial.toml, force_n>=1; several must all hold. Operators: = != < <= > >= (quote < and > in a shell)
    #[arg(long = "where", value_name = "KEY=X", value_parser = Condition::parse)]
    all: Vec<Condition>,
}

#[derive(Clone, Debug)]
struct Condition {
    key: String,
    is_met: IsMet,
    value: String,
    /// The condition as it was typed.
    text: String,
}

impl Condition {
    fn parse(text: &str) -> Result<Self, String> {
        let expected = || "expected KEY, one of = != < <= > >=, and a value, such as force_n>=1";
        let at = text.find(['!', '<', '>', '=']).ok_or_else(expected)?;
        let mut operators = OPERATORS.iter();
        let found = operators.find(|(operator, _)| text[at..].starts_with(operator));
        let (operator, is_met) = *found.ok_or_else(expected)?;
        let (key, value) = (text[..at].trim(), text[at + operator.len()..].trim());
        if key.is_empty() || value.is_empty() {
            return Err(expected().into());
        }
        Ok(Self { key: key.into(), is_met, value: normal(value), text: text.into() })
    }

    /// Whether a trial's value meets the condition. Fails if the two cannot be compared.
    fn holds(&self, there: &Value) -> Result<bool, String> {
        let Self { key, value, .. } = self;
        let number = |there: f64| Some(there.partial_cmp(&value.parse().ok()?));
        let order = match there {
            Value::String(there) => Some(Some(normal(there).cmp(value))),
            Value::Integer(there) => number(*there as f64),
            Value::Float(there) => number(*there),
            Value::Boolean(there) => value.parse().ok().map(|value| Some(there.cmp(&value))),
            _ => None,
        };
        let problem = || format!("{key} is {there}, which cannot be compared with {value}");
        // A value that is not a number (NaN) is neither equal, less nor more.
        Ok(order.ok_or_else(problem)?.is_some_and(self.is_met))
    }
}

/// The value of a key of a trial: its surface, user, session or number, or a key under `[meta]`.
pub(super) fn value_of(entry: &Entry, meta: &toml::Table, key: &str) -> Option<Value> {
    match key {
        "surface" => Some(entry.key.surface.clone().into()),
        "user" => Some(entry.key.user.clone().into()),
        "session" => entry.key.session.clone().map(Value::from),
        "trial" => Some(i64::from(entry.key.number).into()),
        key => meta.get(key).cloned(),
    }
}

impl WhereArgs {
    pub(super) fn is_empty(&self) -> bool {
        self.all.is_empty()
    }

    /// Opens the library at `path` with the trials that meet all conditions ([`Self::keep`]).
    pub(super) fn open(&self, path: &Path) -> Done<Library> {
        let mut library = super::open(path)?;
        self.keep(path, &mut library)?;
        Ok(library)
    }

    /// Drops the trials of the library at `path` that do not meet all conditions. A trial without the key
    /// does not meet a condition. Fails if no trial is left, if none has a key, or if a value cannot be
    /// compared.
    pub(super) fn keep(&self, path: &Path, library: &mut Library) -> Done<()> {
        if self.is_empty() {
            return Ok(());
        }
        let about: Result<Vec<_>, _> = library.entries.iter().map(Entry::about).collect();
        let meta: Vec<toml::Table> = about?.into_iter().map(|about| about.meta).collect();
        let before = library.entries.len();
        let mut kept: Vec<bool> = vec![true; before];
        for condition in &self.all {
            let value = |(entry, meta)| value_of(entry, meta, &condition.key);
            let values: Vec<_> = library.entries.iter().zip(&meta).map(value).collect();
            for ((entry, there), kept) in library.entries.iter().zip(&values).zip(&mut kept) {
                let holds = there.as_ref().map_or(Ok(false), |there| condition.holds(there));
                *kept &= holds.map_err(|problem| {
                    Failure::usage_at(path, format!("{}: {problem}", entry.name_in(path)))
                })?;
            }
            if values.iter().all(Option::is_none) {
                let keys: BTreeSet<&String> = meta.iter().flat_map(toml::Table::keys).collect();
                let keys = ["surface", "user", "session", "trial"]
                    .into_iter()
                    .chain(keys.into_iter().map(String::as_str));
                let problem =
                    format!("no trial has the key `{}`; keys: {}", condition.key, listed(keys));
                return Err(Failure::usage_at(path, problem));
            }
        }
        let mut kept = kept.into_iter();
        library.entries.retain(|_| kept.next().unwrap_or_default());
        let all = show::joined(self.all.iter().map(|condition| &condition.text), " and ");
        if library.entries.is_empty() {
            return Err(Failure::usage_at(path, format!("no trial fits {all}")));
        }
        say!("{all}: {} of {}", library.entries.len(), counted(before, "trial"));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn holds(condition: &str, there: impl Into<Value>) -> bool {
        Condition::parse(condition).unwrap().holds(&there.into()).unwrap()
    }

    #[test]
    fn numbers_text_and_truth_values_are_compared_by_all_operators() {
        for (condition, below, at, above) in [
            ("x=2", false, true, false),
            ("x!=2", true, false, true),
            ("x<2", true, false, false),
            ("x<=2", true, true, false),
            ("x>2", false, false, true),
            ("x >= 2", false, true, true),
        ] {
            assert_eq!([1, 2, 10].map(|x| holds(condition, x)), [below, at, above], "{condition}");
            let halves = [1.5, 2.0, 10.5].map(|x| holds(condition, x));
            assert_eq!(halves, [below, at, above], "{condition}");
        }
        assert!(holds("tool=steel tip", "steel tip") && !holds("tool=steel", "steel tip"));
        assert!(holds("session>=2026-11", "2026-11-25") && holds("wet=false", false));
        assert!(!holds("x!=2", f64::NAN));
    }

    #[test]
    fn what_is_no_condition_or_cannot_be_compared_is_refused() {
        for text in ["", "force", "=1", "force=", "force!1"] {
            assert!(Condition::parse(text).is_err(), "{text}");
        }
        for (text, there) in [("x=hard", Value::Integer(1)), ("x=1", Value::Boolean(true))] {
            let error = Condition::parse(text).unwrap().holds(&there).unwrap_err();
            assert!(error.contains("cannot be compared"), "{error}");
        }
    }
}
