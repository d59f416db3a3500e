//! Reads the keys of a TOML file that describes a thing, such as a bench or a tracker, and collects all that is wrong
//! with them, so that one look at the messages is enough to mend the file.

mod found;
mod section;

use std::cell::RefCell;
use std::fmt;
use std::ops::Range;

use toml_edit::{Document, Item, TableLike};

pub use found::Found;
pub use section::Section;

/// How many syntax faults are looked for before a file is given up.
const SYNTAX_FAULTS_MAX: usize = 16;

/// One thing that is wrong with a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fault {
    /// The key's full path, for example `panel.pixel_pitch_um`; empty where the file as a whole is at fault.
    pub key: String,
    /// The line of the file, from 1: of the key, or of its table where the key is missing.
    pub line: Option<usize>,
    /// What the file says.
    pub found: String,
    /// What it may say.
    pub expected: String,
    /// What to do about it.
    pub advice: String,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.line, self.key.as_str()) {
            (Some(line), "") => write!(f, "line {line}: ")?,
            (Some(line), key) => write!(f, "line {line}, {key}: ")?,
            (None, "") => {}
            (None, key) => write!(f, "{key}: ")?,
        }
        write!(f, "found {}; expected {}; {}", self.found, self.expected, self.advice)
    }
}

/// Reads the file whose text is `text` with `make`, which gets the keys outside any table first.
///
/// # Errors
/// Everything that is wrong with the file, in the order of its lines. Of a text that is no TOML, only that.
pub fn read<T>(text: &str, make: impl for<'s> FnOnce(&Section<'s>) -> Option<T>) -> Result<T, Vec<Fault>> {
    let reader = Reader::new(text);
    let document = reader.document();
    let made = document.as_ref().and_then(|document| make(&Section::root(&reader, document.as_table())));
    reader.finish(made)
}

/// A file's text, and its faults so far.
#[derive(Debug)]
struct Reader<'a> {
    text: &'a str,
    faults: RefCell<Vec<Fault>>,
}

impl<'a> Reader<'a> {
    const fn new(text: &'a str) -> Self {
        Self { text, faults: RefCell::new(Vec::new()) }
    }

    /// The document, or nothing where it is not TOML; then every syntax fault is noted that shows up when the faulty
    /// lines before it are left out.
    fn document(&self) -> Option<Document<String>> {
        let mut remaining = self.text.to_owned();
        for found_before in 0..SYNTAX_FAULTS_MAX {
            let error = match Document::parse(remaining.clone()) {
                Ok(document) => return (found_before == 0).then_some(document),
                Err(error) => error,
            };
            let start = error.span().map_or(0, |span| span.start).min(remaining.len());
            let line_start = remaining.as_bytes()[..start].iter().rposition(|&b| b == b'\n').map_or(0, |at| at + 1);
            let line_end = remaining.as_bytes()[start..].iter().position(|&b| b == b'\n');
            let line_end = line_end.map_or(remaining.len(), |at| start + at);
            let content = remaining[line_start..line_end].trim().to_owned();
            let line = self.line_of(Some(start..start));
            self.fault("", line, format!("`{content}`"), "TOML", error.message().replace('\n', ", "));
            if content.is_empty() || content.starts_with('[') {
                return None;
            }
            remaining.replace_range(line_start..line_end, &" ".repeat(line_end - line_start));
        }
        None
    }

    /// The line, from 1, in which `span` begins.
    fn line_of(&self, span: Option<Range<usize>>) -> Option<usize> {
        let bytes = self.text.as_bytes();
        span.map(|span| 1 + bytes[..span.start.min(bytes.len())].iter().filter(|&&b| b == b'\n').count())
    }

    /// The line of `key` in `table`, whose item it is.
    fn line_of_key(&self, table: &dyn TableLike, key: &str, item: &Item) -> Option<usize> {
        self.line_of(table.key(key).and_then(|key| key.span()).or_else(|| item.span()))
    }

    /// Notes a fault, its parts as [`Fault`] has them.
    fn fault(
        &self,
        key: impl Into<String>,
        line: Option<usize>,
        found: impl ToString,
        expected: impl Into<String>,
        advice: impl Into<String>,
    ) {
        let (found, expected) = (found.to_string(), expected.into());
        self.faults.borrow_mut().push(Fault { key: key.into(), line, found, expected, advice: advice.into() });
    }

    /// What was read, where nothing is wrong; else every fault, in the order of the file's lines.
    fn finish<T>(self, read: Option<T>) -> Result<T, Vec<Fault>> {
        let mut faults = self.faults.into_inner();
        match read {
            Some(read) if faults.is_empty() => Ok(read),
            _ => {
                faults.sort_by_key(|fault| fault.line.unwrap_or(usize::MAX));
                Err(faults)
            }
        }
    }
}

/// What stands in the file, short enough for one line.
fn describe(item: &Item) -> String {
    const SHOWN_MAX: usize = 60;
    let text = item.to_string().split_whitespace().collect::<Vec<_>>().join(" ");
    let shown: String = text.chars().take(SHOWN_MAX).collect();
    let more = if shown.len() < text.len() { "..." } else { "" };
    match item.type_name() {
        kind @ ("array" | "inline table" | "integer") => format!("an {kind} {shown}{more}"),
        "table" | "array of tables" => "a table".into(),
        kind => format!("a {kind} {shown}{more}"),
    }
}

/// What is found where nobody asked for `item`.
fn describe_unknown(item: &Item) -> &'static str {
    if item.is_table() { "an unknown table" } else { "an unknown key" }
}

/// The name among `names` that `given` was most likely meant to be.
fn nearest<'n>(given: &str, names: &[&'n str]) -> Option<&'n str> {
    const ALIKE_MIN: f64 = 0.8;
    let alike = |name: &&&str| strsim::jaro_winkler(given, name);
    let best = names.iter().max_by(|a, b| alike(a).total_cmp(&alike(b)))?;
    (alike(&best) >= ALIKE_MIN).then_some(*best)
}

/// Asks for the name that `given` was most likely meant to be.
pub fn did_you_mean(given: &str, names: &[&str]) -> Option<String> {
    nearest(given, names).map(|name| format!("did you mean `{name}`?"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_faulty_line_is_told_in_its_order_and_a_sound_text_gives_its_document() {
        let reader = Reader::new("a = 1\nb = \nc = 2\n");
        reader.fault("c", Some(3), 2, "three", "correct it");
        assert_eq!(reader.document().map(drop), None);
        let faults = reader.finish(Some(())).unwrap_err();
        assert_eq!(faults.iter().map(|fault| fault.line).collect::<Vec<_>>(), [Some(2), Some(3)]);
        assert_eq!(faults[1].to_string(), "line 3, c: found 2; expected three; correct it");

        let reader = Reader::new("a = 1\n");
        assert!(reader.document().is_some_and(|document| document.contains_key("a")));
        assert_eq!(reader.finish(Some(7)), Ok(7));
        assert_eq!(Reader::new("").finish::<()>(None), Err(Vec::new()));
    }

    #[test]
    fn a_name_is_guessed_where_one_is_near() {
        assert_eq!(nearest("widht_px", &["height_px", "width_px"]), Some("width_px"));
        assert_eq!(did_you_mean("x", &["height_px", "width_px"]), None);
    }
}
