//! The form that a sensor's lines have in common: which cells are columns, by place or by name.
//!
//! Lines without names fit if all that stands between their numbers is alike. Lines with names
//! (`ax:0.5`) fit by the names alone, in any order; several lines may make one row.

use super::cells::{Cell, Cells, Kind, LEAD, MOST_CELLS};
use super::numbers::{FRACTION, GROUPED, WHOLE};

/// Number of lines after which other lines replace a form that has lasted.
pub(super) const CHANGED: u32 = 20;
/// Number of alike lines that make a form, if they hold words, as the log of a starting device does.
const WORDED: u32 = 4;
/// Number of rows that make a form of names, after the row that has shown the names.
const NAMED: u32 = 3;

#[derive(Debug, Default)]
struct Key {
    name: u64,
    /// The unit stuck to the column's numbers; `None` before the first number.
    unit: Option<u64>,
    /// The column's label: words before several names, and the name.
    label: [String; 2],
    place: u32,
    /// Number of lines that had the column, until the form was found.
    seen: u32,
    /// All that the digits of its numbers have shown of thousands.
    digits: u8,
}

#[derive(Debug, Default)]
pub(super) struct Form {
    keys: Vec<Key>,
    pub named: bool,
    shape: u64,
    /// Whether commas, semicolons or bars separate the columns.
    pub hard: bool,
    /// Whether the lines hold words, units or hexadecimal numbers.
    pub worded: bool,
    /// Whether each line holds all names.
    whole: bool,
    /// Number of lines that have fitted; at first, of lines or rows alike.
    fits: u64,
    /// Lines that the form was found in, and those of them that held all names.
    lines: u32,
    full: u32,
    row: Vec<f64>,
    filled: Vec<bool>,
    /// The place after the last column that was filled.
    next: usize,
}

impl Form {
    pub(super) fn width(&self) -> usize {
        self.keys.len()
    }

    /// The names of the columns, if the lines hold names.
    pub(super) fn names(&self) -> Vec<String> {
        let labels: Vec<_> =
            self.keys.iter().filter(|key| key.name & LEAD == 0).map(|key| &key.label).collect();
        // A prefix that all names share tells nothing, unless the names themselves are all alike.
        let shared = labels.iter().all(|label| label[0] == labels[0][0])
            && labels.iter().any(|label| label[1] != labels[0][1]);
        let name = |(at, Key { name, label: [prefix, label], place, .. }): (usize, &Key)| {
            let mut text = match name & LEAD != 0 {
                true => (at + 1).to_string(),
                false if shared || prefix.is_empty() => label.clone(),
                false => format!("{prefix} {label}"),
            };
            if *place > 0 {
                text += &format!(" {}", place + 1);
            }
            text
        };
        self.keys.iter().enumerate().map(name).collect()
    }

    /// Takes the cells of a line if they fit, and passes on each row that they complete. A row has
    /// NaN where a number is missing.
    pub(super) fn take(&mut self, cells: &Cells, mut on: impl FnMut(&[f64])) -> bool {
        let fits = match self.named {
            true => self.take_named(&cells.cells, &mut on),
            false => self.is_alike(cells),
        };
        self.fits += u64::from(fits);
        if fits && !self.named {
            self.row.clear();
            self.row.extend(cells.cells.iter().map(|cell| cell.value));
            self.row.resize(self.keys.len(), f64::NAN);
            on(&self.row);
        }
        fits
    }

    /// Whether points may separate thousands in a line: its column has whole numbers of three
    /// digits and numbers such as `1.234`, and none whose point can only be a decimal point.
    pub(super) fn may_have_thousands(&mut self, cells: &Cells) -> bool {
        if !self.named && !self.resembles(cells) {
            return false;
        }
        let (mut found, mut hint) = (false, 0);
        for cell in &cells.cells {
            let at = if self.named { self.find(cell, hint) } else { Some(hint) };
            hint = at.map_or(hint, |at| at + 1);
            let Some(key) = at.and_then(|at| self.keys.get_mut(at)) else { continue };
            key.digits |= cell.digits;
            found |= key.digits & (WHOLE | GROUPED | FRACTION) == WHOLE | GROUPED;
        }
        found
    }

    /// Whether a line without names has this form.
    fn is_alike(&self, cells: &Cells) -> bool {
        let Cells { cells, shape, open, .. } = cells;
        let width = self.keys.len();
        let fits = cells.len() == width || *open && cells.len() + 1 == width;
        let alike = |(cell, key): (&Cell, &Key)| {
            cell.kind != Kind::Number || key.unit.is_none_or(|unit| unit == cell.unit)
        };
        fits && *shape == self.shape && cells.iter().zip(&self.keys).all(alike)
    }

    /// Whether a line has this form, apart from the units of its numbers.
    pub(super) fn resembles(&self, cells: &Cells) -> bool {
        !self.named && cells.cells.len() == self.keys.len() && cells.shape == self.shape
    }

    fn find(&self, cell: &Cell, hint: usize) -> Option<usize> {
        match self.keys.get(hint) {
            Some(key) if key.name == cell.name => Some(hint),
            _ => self.keys.iter().position(|key| key.name == cell.name),
        }
    }

    fn take_named(&mut self, cells: &[Cell], on: &mut impl FnMut(&[f64])) -> bool {
        let lead = |cell: &Cell| cell.name & LEAD != 0;
        if !cells.iter().any(|cell| !lead(cell) && self.find(cell, 0).is_some()) {
            return false;
        }
        let (mut first, mut hint) = (true, 0);
        for cell in cells {
            let Some(at) = self.find(cell, hint) else { continue };
            hint = at + 1;
            if lead(cell) {
                // A clock stands in each line; the first of a row counts.
                if !self.filled[at] {
                    (self.row[at], self.filled[at]) = (cell.value, true);
                }
                continue;
            }
            // Names come back, or stand before the last one: a line is lost, or the row ended early.
            if self.filled[at] || first && at < self.next {
                let clock = self.keys[0].name & LEAD != 0 && first;
                let own = clock.then(|| cells.first().filter(|cell| lead(cell))).flatten();
                self.end_row(on);
                if let Some(own) = own {
                    (self.row[0], self.filled[0]) = (own.value, true);
                }
            }
            first = false;
            // A number in another unit is another quantity.
            let same = self.keys[at].unit.is_none_or(|unit| unit == cell.unit);
            self.row[at] = if same { cell.value } else { f64::NAN };
            self.filled[at] = true;
            self.next = self.next.max(at + 1);
        }
        if self.whole || self.filled.iter().all(|filled| *filled) {
            self.end_row(on);
        }
        true
    }

    fn end_row(&mut self, on: &mut impl FnMut(&[f64])) {
        on(&self.row);
        self.row.fill(f64::NAN);
        self.filled.fill(false);
        self.next = 0;
    }

    /// The form that one line shows. Names that occur twice in it tell no columns apart; then the
    /// places do, and the names are a part of the shape.
    fn of(cells: &Cells, line: &[u8]) -> Self {
        let twice = |(at, cell): (usize, &Cell)| {
            cells.cells[..at].iter().any(|other| other.name == cell.name && cell.name != LEAD)
        };
        let named = cells.named && !cells.cells.iter().enumerate().any(twice);
        let Cells { shape, hard, worded, .. } = *cells;
        let mut form = Self { named, shape, hard, worded, ..Self::default() };
        form.add(cells, line);
        form.fits = u64::from(!named);
        form
    }

    /// Adds a line to the lines that show the form. Returns whether it is of the same form.
    fn join(&mut self, cells: &Cells, line: &[u8]) -> bool {
        if !self.named {
            if !self.is_alike(cells) {
                return false;
            }
            let numbers = cells.cells.iter().zip(&mut self.keys);
            for (cell, key) in numbers.filter(|(cell, _)| cell.kind == Kind::Number) {
                key.unit.get_or_insert(cell.unit);
            }
            self.fits += 1;
            return true;
        }
        let own = || cells.cells.iter().filter(|cell| cell.name & LEAD == 0);
        let known = own().filter(|cell| self.find(cell, 0).is_some()).count();
        if !cells.named
            || known == 0 && self.fits > 0
            || self.keys.len() + cells.cells.len() > MOST_CELLS
        {
            return false;
        }
        let repeats = |cell: &Cell| self.find(cell, 0).is_some_and(|at| self.filled[at]);
        let again = own().any(repeats);
        if again {
            self.fits += 1;
            self.filled.fill(false);
        }
        if known < own().count() && self.fits > 0 {
            (self.fits, self.lines, self.full) = (0, 0, 0);
        }
        self.add(cells, line);
        true
    }

    fn add(&mut self, cells: &Cells, line: &[u8]) {
        for cell in &cells.cells {
            let found = if self.named { self.find(cell, 0) } else { None };
            let at = found.unwrap_or_else(|| {
                let text = |(begin, end): (usize, usize)| {
                    let text = String::from_utf8_lossy(&line[begin..end]);
                    let mark = |c: char| c.is_whitespace() || ":=\"'()[]{}<>,;".contains(c);
                    let words: Vec<&str> =
                        text.split(mark).filter(|word| !word.is_empty()).collect();
                    words.join(" ").chars().take(64).collect()
                };
                let Cell { name, label, place, .. } = *cell;
                let key =
                    Key { name, unit: None, label: label.map(text), place, seen: 0, digits: 0 };
                self.keys.push(key);
                self.filled.push(false);
                self.row.push(f64::NAN);
                self.keys.len() - 1
            });
            self.keys[at].seen += 1;
            self.filled[at] = true;
            if cell.kind == Kind::Number {
                self.keys[at].unit.get_or_insert(cell.unit);
            }
        }
        self.lines += 1;
        self.full += u32::from(cells.cells.len() >= self.keys.len());
    }

    /// Lets the row begin with its first name by the alphabet (as in `x`, `y`, `z`), if the others
    /// then follow in this order. Without that, the row begins with the name that came first.
    fn begin_by_alphabet(&mut self) {
        let lead = self.keys.iter().take_while(|key| key.name & LEAD != 0).count();
        let names = &mut self.keys[lead..];
        fn order(key: &Key) -> (&[String; 2], u32) {
            (&key.label, key.place)
        }
        let first =
            (0..names.len()).min_by(|one, two| order(&names[*one]).cmp(&order(&names[*two])));
        names.rotate_left(first.unwrap_or(0));
        if !names.is_sorted_by(|one, two| order(one) <= order(two)) {
            names.rotate_right(first.unwrap_or(0));
        }
    }

    /// Number of rows or lines of one form that make a form.
    fn needed(&self) -> u32 {
        match (self.named, self.worded) {
            (true, _) => NAMED,
            (false, true) => WORDED,
            (false, false) => 1,
        }
    }
}

/// Finds the form of lines that do not have the form so far.
#[derive(Debug, Default)]
pub(super) struct FormFinder {
    candidates: Vec<Form>,
}

/// Most forms that are followed at once.
const MOST_FORMS: usize = 4;

impl FormFinder {
    /// Takes a line that does not fit `old`. Returns the new form, if enough lines show it.
    pub(super) fn take(&mut self, cells: &Cells, line: &[u8], old: Option<&Form>) -> Option<Form> {
        let at = self.candidates.iter_mut().position(|form| form.join(cells, line));
        let at = at.unwrap_or_else(|| {
            if self.candidates.len() == MOST_FORMS {
                let rarest = (0..MOST_FORMS).min_by_key(|at| self.candidates[*at].fits);
                self.candidates.remove(rarest.unwrap_or(0));
            }
            self.candidates.push(Form::of(cells, line));
            self.candidates.len() - 1
        });
        let fits = self.candidates[at].fits;
        let lasting = old.map_or(0, |old| (old.fits + 1).min(u64::from(CHANGED)));
        let needed = lasting.max(u64::from(self.candidates[at].needed()));
        // Lines of a log come less often than rows.
        let rare = |(other, form): (usize, &Form)| other == at || 3 * form.fits <= 2 * fits;
        if fits < needed || !self.candidates.iter().enumerate().all(rare) {
            return None;
        }
        let mut form = self.candidates.swap_remove(at);
        self.candidates.clear();
        if form.named {
            // Columns of lines that came only once are no part of the row.
            let lines = form.keys.iter().map(|key| key.seen).max().unwrap_or(0);
            form.keys.retain(|key| key.seen * 2 > lines.min(4));
            form.whole = 2 * form.full > form.lines;
            if !form.whole {
                form.begin_by_alphabet();
            }
        }
        let width = form.keys.len();
        (form.row, form.filled) = (vec![f64::NAN; width], vec![false; width]);
        (form.next, form.fits) = (0, 0);
        Some(form)
    }

    /// To be called when a line fits: other lines before it were exceptions.
    pub(super) fn clear(&mut self) {
        self.candidates.clear();
    }
}
