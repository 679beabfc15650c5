//! Makes text safe to show. Labels, serial numbers and messages come from outside, and may hold
//! characters that control a terminal or change how other characters read.

use std::fmt::{self, Write};

/// Shows text, with each invisible character that has an effect written as `\u{…}`: control
/// characters except new lines and tabs, direction marks (Unicode Standard Annex 9), and characters
/// of no width except joiners. A carriage return is written as `\r`.
pub struct Printable<'a>(pub &'a str);

impl fmt::Display for Printable<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.chars().try_for_each(|c| match c {
            '\n' | '\t' => f.write_char(c),
            '\r' => f.write_str("\\r"),
            c if c.is_control() || acts_unseen(c) => write!(f, "{}", c.escape_unicode()),
            c => f.write_char(c),
        })
    }
}

/// Whether an invisible character changes how other characters are shown. Joiners do not count,
/// since some scripts need them.
fn acts_unseen(c: char) -> bool {
    matches!(c,
        '\u{61c}' | '\u{200b}' | '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}'
        | '\u{2060}'..='\u{206f}' | '\u{feff}' | '\u{fff9}'..='\u{fffb}'
        | '\u{e0000}'..='\u{e007f}')
}

/// The JSON text of a struct of text and numbers. JSON can express any such struct.
pub fn json_text(value: &impl serde::Serialize) -> String {
    serde_json::to_string(value).expect("plain data")
}

/// Quotes a word for a shell, if the shell needs quotes to read it as one word.
pub fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_alphanumeric() || "_./-+,:@%=".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        return word.into();
    }
    format!("'{}'", word.replace('\'', "'\\''"))
}

/// A number with its noun in singular or plural: `1 trial`, `2 trials`.
pub fn counted(number: usize, thing: &str) -> String {
    format!("{number} {thing}{}", if number == 1 { "" } else { "s" })
}

/// The first `most` of some texts, with `", "` or `"; "` between them, and how many more there are.
pub fn some_of(texts: &[impl AsRef<str>], most: usize, between: &str) -> String {
    let first: Vec<&str> = texts.iter().take(most).map(AsRef::as_ref).collect();
    let first = first.join(between);
    match texts.len().saturating_sub(most) {
        0 => first,
        more => format!("{first}{} and {more} more", between.trim_matches([',', ' '])),
    }
}

/// Lays out a table: its head, then a line for each row. A column is as wide as its widest cell,
/// and is aligned right if its head begins with `>`.
pub fn table(head: &[&str], rows: &[Vec<String>]) -> String {
    let names: Vec<String> = head.iter().map(|name| name.trim_start_matches('>').into()).collect();
    let lines = || std::iter::once(&names).chain(rows);
    let width = |column: usize| {
        let cells = lines().filter_map(|line| line.get(column));
        cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..head.len()).map(width).collect();
    let mut text = String::new();
    for line in lines() {
        let mut row = String::new();
        for ((cell, &width), head) in line.iter().zip(&widths).zip(head) {
            // Writing to a String cannot fail.
            let _ = match head.starts_with('>') {
                true => write!(row, "{cell:>width$}  "),
                false => write!(row, "{cell:<width$}  "),
            };
        }
        text += row.trim_end();
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_of_a_table_are_as_wide_as_their_cells() {
        let rows = [vec!["oak".into(), "7".into()], vec!["böhm, oiled".into(), "12".into()]];
        let shown = "surface      trials\noak               7\nböhm, oiled      12\n";
        assert_eq!(table(&["surface", ">trials"], &rows), shown);
    }

    #[test]
    fn nothing_is_obeyed_and_nothing_reads_backwards() {
        let label = "oak\x1b]0;mine\x07\r\u{9b}2J \u{202e}eno\u{2066}\u{feff} é نمی‌دانم\n";
        let shown =
            "oak\\u{1b}]0;mine\\u{7}\\r\\u{9b}2J \\u{202e}eno\\u{2066}\\u{feff} é نمی‌دانم\n";
        assert_eq!(Printable(label).to_string(), shown);
    }
}
