//! A file laid over the defaults, both as TOML.

use std::ops::Range;

use serde::de::DeserializeOwned;
use toml::Spanned;
use toml::de::{DeTable, DeValue, Deserializer, Error};

/// The file that holds the defaults.
pub(super) const DEFAULTS: &str = include_str!("../../../configs/stylus.toml");

/// Where values of the defaults stand in the file: nowhere.
const NOWHERE: Range<usize> = 0..0;

/// What `text` says, and `defaults` where it says nothing. The tables of the file itself (such as
/// `[stylus]`) are overlaid key by key; any other value replaces the default as a whole. `format`
/// has no default. Spans are those of `text`.
///
/// # Errors
/// If `text` is not TOML, or not of the form of `T`.
pub(super) fn merged<T: DeserializeOwned>(text: &str, defaults: &str) -> Result<T, Error> {
    let mut all = DeTable::parse(defaults)?.into_inner();
    all.remove("format");
    all = without_spans(all);
    let file = DeTable::parse(text)?;
    let span = file.span();
    for (name, mut value) in file.into_inner() {
        let default = all.remove_entry(&name).map(|(_, default)| default.into_inner());
        if let (DeValue::Table(own), Some(DeValue::Table(mut table))) = (value.get_mut(), default) {
            for (key, value) in std::mem::take(own) {
                table.remove(&key);
                table.insert(key, value);
            }
            *own = table;
        }
        all.insert(name, value);
    }
    T::deserialize(Deserializer::from(Spanned::new(span, all))).map_err(|mut error| {
        error.set_input(Some(text));
        error
    })
}

/// Whether a value is a default.
pub(super) fn is_default<T>(value: &Spanned<T>) -> bool {
    value.span() == NOWHERE
}

fn without_spans(table: DeTable<'_>) -> DeTable<'_> {
    let entries = table.into_iter();
    entries.map(|(key, value)| (Spanned::new(NOWHERE, key.into_inner()), nowhere(value))).collect()
}

fn nowhere(value: Spanned<DeValue<'_>>) -> Spanned<DeValue<'_>> {
    let value = match value.into_inner() {
        DeValue::Table(table) => DeValue::Table(without_spans(table)),
        DeValue::Array(array) => DeValue::Array(array.into_iter().map(nowhere).collect()),
        plain => plain,
    };
    Spanned::new(NOWHERE, value)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    type Tables = BTreeMap<String, BTreeMap<String, Spanned<i64>>>;

    #[test]
    fn a_file_overlays_key_by_key_and_keeps_its_own_places() {
        let text = "[a]\ny = 3\n[c]\nz = 4\n";
        let all: Tables = merged(text, "[a]\nx = 1\ny = 2\n[b]\nx = 5\n").unwrap();
        let value = |table: &str, key: &str| all[table][key].clone();
        assert_eq!([value("a", "x"), value("b", "x")].map(|x| is_default(&x)), [true; 2]);
        assert_eq!((*value("a", "x").get_ref(), *value("a", "y").get_ref()), (1, 3));
        assert_eq!(&text[value("a", "y").span()], "3");
        assert_eq!(*value("c", "z").get_ref(), 4);
    }

    #[test]
    fn errors_point_into_the_file() {
        let error = merged::<Tables>("[a]\n\nx = \"no\"\n", "[a]\nx = 1\n").unwrap_err();
        assert!(error.to_string().contains("line 3"), "{error}");
    }
}
