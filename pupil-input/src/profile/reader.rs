//! Reads keys out of a profile's TOML and keeps count of everything that is wrong with them.

use std::cell::RefCell;
use std::ops::RangeInclusive;

use holod_calibration::toml_source::{Fault, TomlSource, describe, describe_unknown, did_you_mean};
use toml_edit::{Array, Document, Item, TableLike, Value};

/// Reads the values of a file's keys.
pub(super) struct Reader<'a> {
    source: TomlSource<'a>,
}

/// One table, with the keys that were asked of it: any other is unknown.
pub(super) struct Section<'a> {
    reader: &'a Reader<'a>,
    path: String,
    line: Option<usize>,
    table: Option<&'a dyn TableLike>,
    asked: RefCell<Vec<&'static str>>,
}

/// A value, and where it stands.
#[derive(Clone)]
pub(super) struct Found<T> {
    pub(super) value: T,
    pub(super) key: String,
    pub(super) line: Option<usize>,
}

impl<T> Found<T> {
    pub(super) fn with<U>(&self, value: U) -> Found<U> {
        Found { value, key: self.key.clone(), line: self.line }
    }
}

impl<'a> Reader<'a> {
    /// What `read` makes of the file whose text is `text`, starting with its top level.
    ///
    /// # Errors
    /// Everything that is wrong with the file, in the order of its lines.
    pub(super) fn read<T>(text: &str, read: impl FnOnce(&Section<'_>) -> Option<T>) -> Result<T, Vec<Fault>> {
        let source = TomlSource::new(text);
        let document = source.document();
        let reader = Reader { source };
        let made = document.as_ref().and_then(|document| read(&reader.root(document)));
        reader.source.finish(made)
    }

    fn root(&'a self, document: &'a Document<String>) -> Section<'a> {
        Section {
            reader: self,
            path: String::new(),
            line: None,
            table: Some(document.as_table()),
            asked: RefCell::default(),
        }
    }

    /// Notes what is wrong with a value that was found.
    pub(super) fn fault<T>(&self, at: &Found<T>, found: impl ToString, expected: &str, advice: impl Into<String>) {
        self.source.fault(&at.key, at.line, found, expected, advice);
    }

    /// Notes a value of the wrong type.
    fn wrong_type(&self, at: &Found<&Item>, expected: &str, advice: &str) {
        self.fault(at, describe(at.value), expected, advice);
    }

    /// A number, whole or not.
    pub(super) fn number(&self, at: &Found<&Item>, expected: &str) -> Option<f64> {
        let number = at.value.as_float().or_else(|| at.value.as_integer().map(|number| number as f64));
        if number.is_none() {
            self.wrong_type(at, expected, "write a plain number without quotes");
        }
        number
    }

    /// A whole number in `range`.
    pub(super) fn integer(&self, at: &Found<&Item>, range: RangeInclusive<i64>) -> Option<i64> {
        let expected = format!("a whole number from {} to {}", range.start(), range.end());
        match at.value.as_integer() {
            Some(number) if range.contains(&number) => Some(number),
            Some(number) => {
                self.fault(at, number, &expected, "correct it");
                None
            }
            None => {
                self.wrong_type(at, &expected, "write a whole number without quotes");
                None
            }
        }
    }

    pub(super) fn text(&self, at: &Found<&'a Item>, expected: &str) -> Option<&'a str> {
        let text = at.value.as_str();
        if text.is_none() {
            self.wrong_type(at, expected, "write it in quotes");
        }
        text
    }

    /// One of `choices`.
    pub(super) fn choose<T: Clone>(&self, at: &Found<&'a Item>, choices: &[(&'static str, T)]) -> Option<T> {
        let names: Vec<_> = choices.iter().map(|(name, _)| *name).collect();
        let expected = format!("one of \"{}\"", names.join("\", \""));
        let text = self.text(at, &expected)?;
        let choice = choices.iter().find(|(name, _)| *name == text).map(|(_, value)| value.clone());
        if choice.is_none() {
            self.fault(at, format!("\"{text}\""), &expected, did_you_mean(text, &names).unwrap_or("choose one".into()));
        }
        choice
    }

    /// Bytes: a text, each character of which is one byte, or an array of numbers.
    pub(super) fn bytes(&self, at: &Found<&'a Item>) -> Option<Vec<u8>> {
        const EXPECTED: &str = "bytes: a text such as \"Go\\r\\n\", or numbers such as [0x80, 0x81]";
        if let Some(text) = at.value.as_str() {
            let bytes = unescape(text);
            if let Err(problem) = &bytes {
                self.fault(at, format!("{text:?}"), EXPECTED, problem.as_str());
            }
            return bytes.ok();
        }
        let numbers = at.value.as_array().map(|array| array.iter().map(|value| value.as_integer()?.try_into().ok()));
        let bytes = numbers.and_then(|numbers| numbers.collect::<Option<Vec<u8>>>());
        if bytes.is_none() {
            self.wrong_type(at, EXPECTED, "each number is one byte, 0 to 255");
        }
        bytes
    }

    /// The array's items, each where it stands.
    pub(super) fn items(&self, at: &Found<&'a Item>, expected: &str) -> Vec<Found<Item>> {
        let Some(array) = at.value.as_array() else {
            self.wrong_type(at, expected, "write it in brackets");
            return Vec::new();
        };
        self.each(at, array)
    }

    fn each(&self, at: &Found<&'a Item>, array: &'a Array) -> Vec<Found<Item>> {
        let item = |(index, value): (usize, &Value)| Found {
            value: Item::Value(value.clone()),
            key: format!("{}[{index}]", at.key),
            line: self.source.line_of(value.span()).or(at.line),
        };
        array.iter().enumerate().map(item).collect()
    }
}

impl<'a> Section<'a> {
    pub(super) fn reader(&self) -> &'a Reader<'a> {
        self.reader
    }

    fn path(&self, key: &str) -> String {
        if self.path.is_empty() { key.into() } else { format!("{}.{key}", self.path) }
    }

    /// Whether there is an item called `key`.
    pub(super) fn has(&self, key: &str) -> bool {
        self.table.is_some_and(|table| table.contains_key(key))
    }

    /// The item called `key`, if there is one.
    pub(super) fn get(&self, key: &'static str) -> Option<Found<&'a Item>> {
        self.asked.borrow_mut().push(key);
        let (name, item) = self.table?.get_key_value(key)?;
        let line = self.reader.source.line_of(name.span().or_else(|| item.span())).or(self.line);
        Some(Found { value: item, key: self.path(key), line })
    }

    /// The item called `key`; a fault where there is none.
    pub(super) fn require(&self, key: &'static str, expected: &str) -> Option<Found<&'a Item>> {
        let item = self.get(key);
        if item.is_none() {
            self.missing(key, expected);
        }
        item
    }

    /// Notes what is wrong with the table as a whole.
    pub(super) fn fault(&self, found: &str, expected: &str, advice: &str) {
        self.reader.source.fault(&self.path, self.line, found, expected, advice);
    }

    /// Notes that `key` is missing.
    pub(super) fn missing(&self, key: &str, expected: &str) {
        let place = if self.path.is_empty() { "the top of the file".into() } else { format!("[{}]", self.path) };
        let advice = format!("add {key} to {place}");
        self.reader.source.fault(self.path(key), self.line, "nothing", expected, advice);
    }

    /// The table called `key`; an empty one where there is none.
    pub(super) fn section(&self, key: &'static str) -> Self {
        match self.get(key) {
            Some(found) => self.reader.table(&found),
            None => Section {
                reader: self.reader,
                path: self.path(key),
                line: self.line,
                table: None,
                asked: RefCell::default(),
            },
        }
    }

    pub(super) fn text(&self, key: &'static str, expected: &str) -> Option<&'a str> {
        self.reader.text(&self.get(key)?, expected)
    }

    pub(super) fn integer(&self, key: &'static str, range: RangeInclusive<i64>) -> Option<i64> {
        self.reader.integer(&self.get(key)?, range)
    }

    /// A number greater than nothing.
    pub(super) fn positive(&self, key: &'static str) -> Option<f64> {
        let found = self.get(key)?;
        let number = self.reader.number(&found, "a number above 0")?;
        let good = number.is_finite() && number > 0.0;
        if !good {
            self.reader.fault(&found, number, "a number above 0", "correct it");
        }
        good.then_some(number)
    }

    /// Whether the file has this table.
    pub(super) const fn is_there(&self) -> bool {
        self.table.is_some()
    }

    /// A finite number.
    pub(super) fn finite(&self, key: &'static str) -> Option<f64> {
        let found = self.get(key)?;
        let number = self.reader.number(&found, "a number")?;
        if !number.is_finite() {
            self.reader.fault(&found, number, "a finite number", "correct it");
        }
        number.is_finite().then_some(number)
    }

    pub(super) fn flag(&self, key: &'static str) -> bool {
        let Some(found) = self.get(key) else { return false };
        let flag = found.value.as_bool();
        if flag.is_none() {
            self.reader.wrong_type(&found, "true or false", "write true or false, without quotes");
        }
        flag.unwrap_or_default()
    }

    pub(super) fn choice<T: Clone>(&self, key: &'static str, choices: &[(&'static str, T)]) -> Option<T> {
        self.reader.choose(&self.get(key)?, choices)
    }

    pub(super) fn bytes(&self, key: &'static str) -> Option<Vec<u8>> {
        self.reader.bytes(&self.get(key)?)
    }

    /// Notes every key that nobody asked for.
    pub(super) fn finish(&self) {
        let Some(table) = self.table else { return };
        let mut asked = self.asked.borrow().clone();
        let mut seen = Vec::new();
        asked.retain(|key| {
            !seen.contains(key) && {
                seen.push(*key);
                true
            }
        });
        for (name, item) in table.iter().filter(|(name, _)| !asked.contains(name)) {
            let line = self.reader.source.line_of_key(table, name, item).or(self.line);
            let expected = format!("one of {}", asked.join(", "));
            let advice = did_you_mean(name, &asked).unwrap_or("take it out".into());
            self.reader.source.fault(self.path(name), line, describe_unknown(item), expected, advice);
        }
    }
}

impl<'a> Reader<'a> {
    /// An empty table in place of what stands at `found`.
    pub(super) fn empty<T>(&'a self, found: &Found<T>) -> Section<'a> {
        Section { reader: self, path: found.key.clone(), line: found.line, table: None, asked: RefCell::default() }
    }

    /// The table that stands at `found`; an empty one, with a fault, where something else stands there.
    pub(super) fn table(&'a self, found: &Found<&'a Item>) -> Section<'a> {
        let table = found.value.as_table_like();
        if table.is_none() {
            self.wrong_type(found, "a table", "write { key = value, ... } or a line with its name in brackets");
        }
        Section { reader: self, path: found.key.clone(), line: found.line, table, asked: RefCell::default() }
    }
}

/// Takes `\r`, `\n`, `\t`, `\0`, `\\` and `\xNN` for what they mean, as a literal text of TOML leaves them; any other
/// character up to U+00FF is the byte of its number.
fn unescape(text: &str) -> Result<Vec<u8>, String> {
    let byte = |c: char| u8::try_from(c).map_err(|_| format!("`{c}` is no single byte: write \\xNN for each byte"));
    let mut bytes = Vec::new();
    let mut chars = text.chars();
    while let Some(c) = chars.next() {
        bytes.push(match (c, if c == '\\' { chars.next() } else { None }) {
            ('\\', Some('r')) => b'\r',
            ('\\', Some('n')) => b'\n',
            ('\\', Some('t')) => b'\t',
            ('\\', Some('0')) => 0,
            ('\\', Some('\\')) => b'\\',
            ('\\', Some('x')) => {
                let digits: String = chars.by_ref().take(2).collect();
                let number = (digits.len() == 2).then(|| u8::from_str_radix(&digits, 16).ok()).flatten();
                number.ok_or_else(|| format!("`\\x{digits}` lacks its two hexadecimal digits"))?
            }
            ('\\', other) => {
                let other: String = other.into_iter().collect();
                return Err(format!("`\\{other}` is no escape: there are \\r \\n \\t \\0 \\\\ \\xNN"));
            }
            (c, _) => byte(c)?,
        });
    }
    Ok(bytes)
}
