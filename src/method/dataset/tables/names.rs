//! Patterns of file paths, which name surface, user, trial and session.

/// A pattern for file paths: text, the fields `{surface}`, `{user}`, `{trial}` and `{session}`, and
/// `*` for any text. Fields and `*` match at least one character, but no `/`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NamePattern(pub String);

impl NamePattern {
    /// Reads surface, user, trial (text that ends with the number) and session from the path `name`.
    /// Compares as many of the path's last components as the pattern has; `None` if they do not
    /// fit. Each field takes the shortest text that lets the rest of the path fit.
    pub(crate) fn parts(&self, name: &str) -> Option<[Option<String>; 4]> {
        let depth = self.0.matches('/').count();
        let from = name.rmatch_indices('/').nth(depth).map_or(0, |(at, _)| at + 1);
        let mut parts = [None, None, None, None];
        fits(&self.0, &name[from..], &mut parts).then_some(parts)
    }
}

fn fits(pattern: &str, name: &str, parts: &mut [Option<String>; 4]) -> bool {
    let fields = ["{surface}", "{user}", "{trial}", "{session}", "*"];
    let Some(field) = fields.iter().position(|field| pattern.starts_with(field)) else {
        return match (pattern.chars().next(), name.chars().next()) {
            (None, None) => true,
            (Some(a), Some(b)) if a == b => {
                fits(&pattern[a.len_utf8()..], &name[b.len_utf8()..], parts)
            }
            _ => false,
        };
    };
    let ends = name.char_indices().map(|(at, c)| (at + c.len_utf8(), c));
    for (end, _) in ends.take_while(|(_, c)| *c != '/') {
        if fits(&pattern[fields[field].len()..], &name[end..], parts) {
            if let Some(part) = parts.get_mut(field) {
                *part = Some(name[..end].to_string());
            }
            return true;
        }
    }
    false
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_by_their_pattern() {
        let parts = |pattern: &str, name: &str| {
            let found = NamePattern(pattern.into()).parts(name)?;
            Some(found.map(Option::unwrap_or_default))
        };
        let of = |a: &str, b: &str, c: &str| Some([a, b, c, ""].map(String::from));
        assert_eq!(parts("{surface}/{trial}", "a/Eiche/3"), of("Eiche", "", "3"));
        assert_eq!(parts("{surface}_{user}_{trial}", "oak_anna_07"), of("oak", "anna", "07"));
        assert_eq!(
            parts("{user}/*-{surface}_{trial}", "x/ben/run-oak 2_4"),
            of("oak 2", "ben", "4")
        );
        assert_eq!(parts("{surface}_{trial}", "oak"), None);
        let with_session = ["oak", "", "4", "monday"].map(String::from);
        assert_eq!(parts("{session}/{surface}_{trial}", "x/monday/oak_4"), Some(with_session));
    }
}
