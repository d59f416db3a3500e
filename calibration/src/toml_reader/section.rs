//! A table of a file, which gives the values of its keys.

use std::cell::RefCell;
use std::ops::RangeInclusive;
use std::sync::LazyLock;

use toml_edit::{Item, Table, TableLike};

use super::found::one_of;
use super::{Found, Reader, describe_unknown, did_you_mean};

/// What stands in for the table of a place that is written without one.
static EMPTY: LazyLock<Table> = LazyLock::new(Table::new);

/// One table of a file.
#[derive(Clone)]
pub struct Section<'a> {
    reader: &'a Reader<'a>,
    /// Its name behind those of the tables around it; empty for the top of the file.
    path: String,
    /// The line of the file, from 1, in which it begins.
    line: Option<usize>,
    table: Option<&'a dyn TableLike>,
    /// What gives the keys that the table leaves out.
    behind: Option<&'a Table>,
    excused: &'static [&'static str],
    /// The keys that were asked of it, each once.
    asked: RefCell<Vec<&'static str>>,
}

impl<'a> Section<'a> {
    fn new(reader: &'a Reader<'a>, path: String, line: Option<usize>, table: Option<&'a dyn TableLike>) -> Self {
        Self { reader, path, line, table, behind: None, excused: &[], asked: RefCell::default() }
    }

    /// The keys outside any table.
    pub(super) fn root(reader: &'a Reader<'a>, table: &'a Table) -> Self {
        Self::new(reader, String::new(), None, Some(table))
    }

    /// `table`, which stands at `found`.
    pub(super) fn at<T>(found: &Found<'a, T>, table: Option<&'a dyn TableLike>) -> Self {
        Self::new(found.reader, found.key.clone(), found.line, table)
    }

    /// A table without keys in place of what stands at `found`.
    pub fn empty<T>(found: &Found<'a, T>) -> Self {
        Self::at(found, Some(&*EMPTY))
    }

    /// The section with `behind` to give the keys that the file leaves out; they are in no line.
    pub(crate) fn with_behind(&self, behind: Option<&'a Table>) -> Self {
        Self { behind, ..self.clone() }
    }

    /// The section with `keys` excused from being required.
    pub(crate) fn excusing(&self, keys: &'static [&'static str]) -> Self {
        Self { excused: keys, ..self.clone() }
    }

    fn path(&self, key: &str) -> String {
        if self.path.is_empty() { key.into() } else { format!("{}.{key}", self.path) }
    }

    /// Whether the file has this table, or a place that stands for one.
    pub const fn is_there(&self) -> bool {
        self.table.is_some()
    }

    /// Whether the file itself gives `key` here.
    pub fn has(&self, key: &str) -> bool {
        self.table.is_some_and(|table| table.contains_key(key))
    }

    /// Whether the file gives `key`, or what is behind it.
    pub(crate) fn gives(&self, key: &str) -> bool {
        self.has(key) || self.behind.is_some_and(|behind| behind.contains_key(key))
    }

    /// The item called `key`, if there is one.
    pub fn get(&self, key: &'static str) -> Option<Found<'a, &'a Item>> {
        if !self.asked.borrow().contains(&key) {
            self.asked.borrow_mut().push(key);
        }
        if let Some((name, item)) = self.table.and_then(|table| table.get_key_value(key)) {
            let line = self.reader.line_of(name.span().or_else(|| item.span())).or(self.line);
            return Some(Found { line, ..self.assumed(key, item) });
        }
        Some(self.assumed(key, self.behind?.get(key)?))
    }

    /// The item called `key`; a fault where there is none.
    pub fn require(&self, key: &'static str, expected: &str) -> Option<Found<'a, &'a Item>> {
        let item = self.get(key);
        if item.is_none() {
            self.missing(key, expected);
        }
        item
    }

    /// What holds for a `key` that the file does not give.
    pub(crate) fn assumed<T>(&self, key: &str, value: T) -> Found<'a, T> {
        Found { value, key: self.path(key), line: None, reader: self.reader }
    }

    /// The line of `key`, from 1, where the file gives it.
    pub(crate) fn line_of(&self, key: &'static str) -> Option<usize> {
        self.get(key)?.line
    }

    /// Notes what is wrong with the table as a whole.
    pub fn fault(&self, found: &str, expected: &str, advice: &str) {
        self.reader.fault(&self.path, self.line, found, expected, advice);
    }

    /// Notes what is wrong with `key`, in the table's own line where none is given.
    pub(crate) fn fault_at(
        &self,
        key: &str,
        line: Option<usize>,
        found: &str,
        expected: &str,
        advice: impl Into<String>,
    ) {
        self.reader.fault(self.path(key), line.or(self.line), found, expected, advice);
    }

    /// Notes that `key` is missing. A missing table is one fault, not one for each of its keys.
    pub fn missing(&self, key: &str, expected: &str) {
        if self.is_there() && !self.excused.contains(&key) {
            let place = if self.path.is_empty() { "the top of the file".into() } else { format!("[{}]", self.path) };
            self.fault_at(key, None, "nothing", expected, format!("add {key} to {place}"));
        }
    }

    /// The table called `key`; one that is not there where the file has none.
    pub fn section(&self, key: &'static str) -> Self {
        let Some(found) = self.get(key) else { return Self::new(self.reader, self.path(key), self.line, None) };
        found.table_or("a table", format!("begin the table with a line [{}]", found.key))
    }

    /// The table called `name`; a fault where it is missing.
    pub(crate) fn required_section(&self, name: &'static str) -> Self {
        if !self.has(name) {
            self.fault_at(name, None, "no such table", "the table", format!("add a line [{name}] and its keys"));
        }
        self.section(name)
    }

    /// The tables `[[name]]`, at most `count_max` of them.
    pub(crate) fn sections(&self, name: &'static str, count_max: usize) -> Option<Vec<Self>> {
        let Some(found) = self.get(name) else { return Some(Vec::new()) };
        let Some(tables) = found.value.as_array_of_tables().filter(|tables| tables.len() <= count_max) else {
            let expected = format!("1 to {count_max} tables");
            found.wrong_type(&expected, format!("begin each table with a line [[{name}]]"));
            return None;
        };
        let section =
            |table: &'a Table| Self::new(self.reader, self.path(name), self.reader.line_of(table.span()), Some(table));
        Some(tables.iter().map(section).collect())
    }

    /// A text with something in it, where the key is there.
    pub fn text(&self, key: &'static str, expected: &str) -> Option<Found<'a, &'a str>> {
        let found = self.get(key)?;
        Some(found.with(found.text(expected)?))
    }

    /// A text with something in it; a fault where the key is missing.
    pub fn required_text(&self, key: &'static str, expected: &str) -> Option<Found<'a, &'a str>> {
        let found = self.require(key, expected)?;
        Some(found.with(found.required_text(expected)?))
    }

    /// One of the named choices; a fault where the key is missing and `required`.
    pub fn choice<T: Clone>(
        &self,
        key: &'static str,
        choices: &[(&'static str, T)],
        required: bool,
    ) -> Option<Found<'a, T>> {
        let found = self.get(key);
        if found.is_none() && required {
            self.missing(key, &one_of(choices));
        }
        let found = found?;
        Some(found.with(found.choose(choices)?))
    }

    /// A whole number in `range`, where the key is there.
    pub fn integer(&self, key: &'static str, range: RangeInclusive<i64>) -> Option<i64> {
        self.get(key)?.integer(range)
    }

    /// A finite number above 0, where the key is there.
    pub fn positive(&self, key: &'static str) -> Option<f64> {
        self.number_that(key, ["a number above 0"; 2], |number| number.is_finite() && number > 0.0)
    }

    /// A finite number, where the key is there.
    pub fn finite(&self, key: &'static str) -> Option<f64> {
        self.number_that(key, ["a number", "a finite number"], f64::is_finite)
    }

    fn number_that(&self, key: &'static str, [any, good]: [&str; 2], is_good: fn(f64) -> bool) -> Option<f64> {
        let found = self.get(key)?;
        let number = found.number(any)?;
        if !is_good(number) {
            found.fault(number, good, "correct it");
        }
        is_good(number).then_some(number)
    }

    /// True or false; `default` where the key is missing.
    pub fn flag(&self, key: &'static str, default: bool) -> bool {
        let Some(found) = self.get(key) else { return default };
        found.value.as_bool().unwrap_or_else(|| {
            found.wrong_type("true or false", "write true or false, without quotes");
            default
        })
    }

    /// Notes every key that nobody has asked for.
    pub fn finish(&self) {
        self.reject_unknown(&self.asked.borrow(), |_| None);
    }

    /// Notes every key that is not in the section's part of `layout`, which holds the keys of every section by its
    /// name, to say where a misplaced one belongs; `retired` are sections' keys that there were once, each with what to
    /// do about it.
    pub(crate) fn check_layout(&self, layout: &[(&str, &[&str])], retired: &[(&str, &str, &str)]) {
        let known = layout.iter().find(|(name, _)| *name == self.path).map_or(&[][..], |(_, keys)| keys);
        self.reject_unknown(known, |key| {
            if let Some((.., advice)) = retired.iter().find(|(name, once, _)| (*name, *once) == (&*self.path, key)) {
                return Some((*advice).into());
            }
            match layout.iter().find(|(name, keys)| *name != self.path && keys.contains(&key))? {
                ("", _) => Some(format!("move `{key}` above the first table")),
                (home, _) => Some(format!("move `{key}` to [{home}]")),
            }
        });
    }

    /// Notes every key that is not `known`, with the advice that there is for it.
    pub(crate) fn reject_unknown(&self, known: &[&str], advice: impl Fn(&str) -> Option<String>) {
        let keys = self.table.into_iter().flat_map(|table| table.iter());
        for (key, item) in keys.filter(|(key, _)| !known.contains(key)) {
            let line = self.table.and_then(|table| self.reader.line_of_key(table, key, item));
            let advice = advice(key).or_else(|| did_you_mean(key, known)).unwrap_or("take it out".into());
            self.fault_at(key, line, describe_unknown(item), &format!("one of {}", known.join(", ")), advice);
        }
    }
}

impl<'a> Found<'a, &'a Item> {
    /// A table; where something else stands there, a fault and a table without keys, none of which is then missing.
    pub fn table(&self) -> Section<'a> {
        self.table_or("a table", "write { key = value, ... } or a line with its name in brackets")
    }

    /// The same, with what is expected and advised where something else stands there.
    pub(crate) fn table_or(&self, expected: &str, advice: impl Into<String>) -> Section<'a> {
        let table = self.value.as_table_like();
        if table.is_none() {
            self.wrong_type(expected, advice);
        }
        Section::at(self, table)
    }
}
