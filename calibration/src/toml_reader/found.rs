//! A value of a file, which knows its place.

use std::ops::RangeInclusive;

use toml_edit::{Item, Value};

use super::{Reader, describe, nearest};

/// A value, and where it stands.
#[derive(Clone, Debug)]
pub struct Found<'a, T> {
    /// The value, as far as it has been read.
    pub value: T,
    /// Its key's full path, for example `serial.start[0].send`.
    pub key: String,
    /// The line of the file, from 1; none of what comes from elsewhere.
    pub(crate) line: Option<usize>,
    pub(super) reader: &'a Reader<'a>,
}

impl<'a, T> Found<'a, T> {
    /// Another value in the same place.
    pub fn with<U>(&self, value: U) -> Found<'a, U> {
        Found { value, key: self.key.clone(), line: self.line, reader: self.reader }
    }

    /// Notes what is wrong with the value.
    pub fn fault(&self, found: impl ToString, expected: &str, advice: impl Into<String>) {
        self.reader.fault(&self.key, self.line, found, expected, advice);
    }
}

impl<'a> Found<'a, &'a Item> {
    /// Notes that the value is of the wrong type.
    pub fn wrong_type(&self, expected: &str, advice: impl Into<String>) {
        self.fault(describe(self.value), expected, advice);
    }

    /// A number, whole or not.
    pub fn number(&self, expected: &str) -> Option<f64> {
        let number = self.value.as_float().or_else(|| self.value.as_integer().map(|number| number as f64));
        if number.is_none() {
            self.wrong_type(expected, "write a plain number without quotes");
        }
        number
    }

    /// A whole number in `range`.
    pub fn integer(&self, range: RangeInclusive<i64>) -> Option<i64> {
        let expected = format!("a whole number from {} to {}", range.start(), range.end());
        match self.value.as_integer() {
            Some(number) if range.contains(&number) => return Some(number),
            Some(number) => self.fault(number, &expected, "correct it"),
            None => self.wrong_type(&expected, "write a whole number without quotes"),
        }
        None
    }

    /// A text of any characters, or of none.
    pub fn raw_text(&self, expected: &str) -> Option<&'a str> {
        let text = self.value.as_str();
        if text.is_none() {
            self.wrong_type(expected, "write it in double quotes");
        }
        text
    }

    /// A text with something in it, and no NUL character, of a key that may be left out.
    pub fn text(&self, expected: &str) -> Option<&'a str> {
        self.text_or(expected, "fill it in or take it out")
    }

    /// The same of a key that may not.
    pub(super) fn required_text(&self, expected: &str) -> Option<&'a str> {
        self.text_or(expected, "fill it in")
    }

    fn text_or(&self, expected: &str, advice_if_empty: &str) -> Option<&'a str> {
        let text = self.raw_text(expected)?;
        if text.contains('\0') {
            self.fault("a text with a NUL character", expected, "take that out");
        } else if text.trim().is_empty() {
            self.fault("an empty text", expected, advice_if_empty);
        } else {
            return Some(text);
        }
        None
    }

    /// What one of the named `choices` stands for.
    pub fn choose<T: Clone>(&self, choices: &[(&'static str, T)]) -> Option<T> {
        let expected = one_of(choices);
        let text = self.raw_text(&expected)?;
        let choice = choices.iter().find(|(name, _)| *name == text).map(|(_, value)| value.clone());
        if choice.is_none() {
            let names: Vec<_> = choices.iter().map(|(name, _)| *name).collect();
            let advice = nearest(text, &names).map_or("choose one".into(), |name| format!("did you mean \"{name}\"?"));
            self.fault(format!("{text:?}"), &expected, advice);
        }
        choice
    }

    /// An array's items, each where it stands.
    pub fn items(&self, expected: &str) -> Vec<Found<'a, Item>> {
        let Some(array) = self.value.as_array() else {
            self.wrong_type(expected, "write it in brackets");
            return Vec::new();
        };
        let item = |(index, value): (usize, &Value)| Found {
            value: Item::Value(value.clone()),
            key: format!("{}[{index}]", self.key),
            line: self.reader.line_of(value.span()).or(self.line),
            reader: self.reader,
        };
        array.iter().enumerate().map(item).collect()
    }
}

/// What is expected where one of `choices` is to be named.
pub(super) fn one_of<T>(choices: &[(&'static str, T)]) -> String {
    let names: Vec<_> = choices.iter().map(|(name, _)| format!("\"{name}\"")).collect();
    format!("one of {}", names.join(", "))
}
