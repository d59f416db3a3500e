//! Reads keys out of a TOML document and keeps count of everything that is wrong with them.

use toml_edit::{Document, Item, Table, TableLike, Value};

use super::files::FileFault;
use crate::toml_source::{Fault, TomlSource, describe, describe_unknown, did_you_mean, nearest};
use crate::{Colour, PerColour};

/// The numbers that a key takes.
#[derive(Clone, Copy, Debug)]
pub struct Span {
    /// The smallest number that is taken, in the unit.
    pub min: f64,
    /// The largest number that is taken, in the unit.
    pub max: f64,
    /// The unit that the key's suffix names.
    pub(super) unit: &'static str,
    /// Units that are given by mistake, each with the factor that turns it into `unit`.
    pub(super) slips: &'static [(&'static str, f64)],
    /// Whether infinity is taken, too.
    pub(super) or_infinite: bool,
}

impl Span {
    /// The numbers from `min` to `max`.
    pub(super) const fn new(min: f64, max: f64, unit: &'static str) -> Self {
        Self { min, max, unit, slips: &[], or_infinite: false }
    }

    /// Adds the units that are given by mistake.
    pub(super) const fn slips(self, slips: &'static [(&'static str, f64)]) -> Self {
        Self { slips, ..self }
    }

    /// Takes infinity, too.
    pub(super) const fn or_infinite(self) -> Self {
        Self { or_infinite: true, ..self }
    }

    /// Whether `value` is one of them.
    pub fn takes(&self, value: f64) -> bool {
        (value >= self.min && value <= self.max) || (self.or_infinite && value == f64::INFINITY)
    }

    /// What is expected, for errors.
    pub fn expected(&self) -> String {
        let gap = if self.unit.is_empty() { "" } else { " " };
        let infinite = if self.or_infinite { ", or inf" } else { "" };
        format!("a number from {} to {}{gap}{}{infinite}", self.min, self.max, self.unit)
    }

    /// What is expected, and what to do, where `value` is not taken.
    pub(super) fn fault(&self, value: f64) -> Option<String> {
        (!self.takes(value)).then(|| format!("expected {}; {}", self.expected(), self.advice(value)))
    }

    fn advice(&self, value: f64) -> String {
        self.slip(value).unwrap_or_else(|| "correct it".into())
    }

    /// What to write where `value` is given in one of the units that are given by mistake.
    pub(super) fn slip(&self, value: f64) -> Option<String> {
        let (unit, factor) = self.slips.iter().find(|(_, factor)| self.takes(value * factor))?;
        let converted = rounded(value * factor);
        Some(format!("{value} looks like {unit}: write {converted} for {converted} {}", self.unit))
    }

    /// How to write for each colour what `given` says, where it can be told: a figure that nobody wrote could be a
    /// power that no eye bears.
    fn for_each_colour(&self, given: &Item) -> Option<String> {
        if let Some(number) = number_in(given) {
            return self.takes(number).then(|| each_colour([number; 3]));
        }
        let numbers: Option<Vec<f64>> = given.as_array()?.iter().map(number_of_value).collect();
        let numbers = <[f64; 3]>::try_from(numbers?).ok().filter(|numbers| numbers.iter().all(|n| self.takes(*n)))?;
        Some(format!("if they are red, green and blue: {}", each_colour(numbers)))
    }
}

/// The advice to write these figures as red's, green's and blue's.
fn each_colour(figures: [impl std::fmt::Display; 3]) -> String {
    let [red, green, blue] = figures;
    format!("write it as {{ red = {red}, green = {green}, blue = {blue} }}")
}

/// A number without the last digits that a conversion of units leaves behind.
fn rounded(value: f64) -> f64 {
    let rounded = (value * 1e9).round() / 1e9;
    if rounded == 0.0 { value } else { rounded }
}

/// A value and the line that it stands in; no line where it comes from a panel profile.
#[derive(Clone, Copy)]
pub(super) struct Found<T> {
    pub(super) value: T,
    pub(super) line: Option<usize>,
}

/// One table of the rig file, with the values of a panel profile behind it.
#[derive(Clone, Copy)]
pub(super) struct Section<'a> {
    pub(super) name: &'static str,
    table: Option<&'a dyn TableLike>,
    line: Option<usize>,
    profile: Option<&'a Table>,
    excused: &'static [&'static str],
}

impl<'a> Section<'a> {
    /// The section with `profile` behind it, for the keys that the rig file leaves out.
    pub(super) fn with_profile(self, profile: Option<&'a Table>) -> Self {
        Self { profile, ..self }
    }

    /// The section with `keys` excused from being required.
    pub(super) fn excusing(self, keys: &'static [&'static str]) -> Self {
        Self { excused: keys, ..self }
    }

    /// Whether the rig file itself gives `key`.
    pub(super) fn has(&self, key: &str) -> bool {
        self.table.is_some_and(|table| table.contains_key(key))
    }

    /// Whether the rig file or the panel's profile gives `key`.
    pub(super) fn gives(&self, key: &str) -> bool {
        self.has(key) || self.profile.is_some_and(|profile| profile.contains_key(key))
    }

    fn path(&self, key: &str) -> String {
        if self.name.is_empty() { key.into() } else { format!("{}.{key}", self.name) }
    }
}

/// Reads the values of a file's keys.
pub(super) struct Reader<'a> {
    source: TomlSource<'a>,
}

impl<'a> Reader<'a> {
    /// What `read` makes of the file whose text is `text`, starting with its top level.
    ///
    /// # Errors
    /// Everything that is wrong with the file, in the order of its lines.
    pub(super) fn read<T>(
        text: &str,
        read: impl for<'s> FnOnce(&Reader<'s>, Section<'s>) -> Option<T>,
    ) -> Result<T, Vec<Fault>> {
        let source = TomlSource::new(text);
        let document = source.document();
        let reader = Reader { source };
        let made = document.as_ref().and_then(|document| read(&reader, Reader::root(document)));
        reader.source.finish(made)
    }

    /// The keys of the file's top level, outside any table.
    fn root(document: &Document<String>) -> Section<'_> {
        Section { name: "", table: Some(document.as_table()), line: None, profile: None, excused: &[] }
    }

    /// The table `name`; a fault where something else has its name, or where it is required and missing.
    pub(super) fn section(&self, root: Section<'a>, name: &'static str, required: bool) -> Section<'a> {
        let entry = root.table.and_then(|table| table.get_key_value(name));
        let Some((key, item)) = entry else {
            if required {
                self.fault(
                    name.into(),
                    None,
                    "no such table",
                    "the table",
                    format!("add a line [{name}] and its keys"),
                );
            }
            return Section { name, table: None, line: None, profile: None, excused: &[] };
        };
        let line = self.source.line_of(item.span().or_else(|| key.span()));
        let table = item.as_table_like();
        if table.is_none() {
            let found = describe(item);
            self.fault(name.into(), line, &found, "a table", format!("begin the table with a line [{name}]"));
        }
        Section { name, table, line, profile: None, excused: &[] }
    }

    /// Notes a fault.
    pub(super) fn fault(&self, key: String, line: Option<usize>, found: &str, expected: &str, advice: String) {
        self.source.fault(key, line, found, expected, advice);
    }

    /// Notes a fault of a key in `section`.
    pub(super) fn fault_in(
        &self,
        section: Section<'_>,
        key: &str,
        line: Option<usize>,
        found: &str,
        expected: &str,
        advice: String,
    ) {
        self.fault(section.path(key), line.or(section.line), found, expected, advice);
    }

    /// Notes every key of `section` that is not in the section's part of `layout`, which holds the keys of every
    /// section, to tell where a misplaced one belongs; `retired` are sections' keys that there were once, each with
    /// what to do about it.
    pub(super) fn reject_unknown(
        &self,
        section: Section<'a>,
        layout: &[(&'static str, &[&'static str])],
        retired: &[(&str, &str, &str)],
    ) {
        let Some(table) = section.table else { return };
        let known = layout.iter().find(|(name, _)| *name == section.name).map_or(&[][..], |(_, keys)| keys);
        for (key, item) in table.iter() {
            if known.contains(&key) {
                continue;
            }
            let line = self.source.line_of_key(table, key, item);
            let home = layout.iter().find(|(name, keys)| *name != section.name && keys.contains(&key));
            let once = retired.iter().find(|(name, once, _)| (*name, *once) == (section.name, key));
            let advice = match (once, home) {
                (Some((.., advice)), _) => (*advice).into(),
                (_, Some(("", _))) => format!("move `{key}` above the first table"),
                (_, Some((home, _))) => format!("move `{key}` to [{home}]"),
                (_, None) => did_you_mean(key, known).unwrap_or("take it out".into()),
            };
            self.fault_in(section, key, line, describe_unknown(item), &format!("one of {}", known.join(", ")), advice);
        }
    }

    fn lookup(&self, section: Section<'a>, key: &str) -> Option<Found<&'a Item>> {
        if let Some((key, item)) = section.table.and_then(|table| table.get_key_value(key)) {
            return Some(Found { value: item, line: self.source.line_of(key.span().or_else(|| item.span())) });
        }
        let item = section.profile?.get(key)?;
        Some(Found { value: item, line: None })
    }

    /// The line of `key`, where it is there.
    pub(super) fn line_of_key(&self, section: Section<'a>, key: &str) -> Option<usize> {
        self.lookup(section, key)?.line
    }

    fn missing(&self, section: Section<'a>, key: &str, expected: &str) {
        // A missing table is one fault, not one for each of its keys.
        if section.table.is_some() && !section.excused.contains(&key) {
            let advice = format!("add {key} to [{}]", section.name);
            self.fault_in(section, key, None, "nothing", expected, advice);
        }
    }

    fn wrong_type(&self, section: Section<'a>, key: &str, found: Found<&Item>, expected: &str, advice: String) {
        let described = describe(found.value);
        self.fault_in(section, key, found.line, &described, expected, advice);
    }

    /// A number within `span`, where the key is there.
    pub(super) fn number(&self, section: Section<'a>, key: &str, span: Span) -> Option<Found<f64>> {
        let found = self.lookup(section, key)?;
        let value = self.number_of(section, key, found, span)?;
        Some(Found { value, line: found.line })
    }

    fn number_of(&self, section: Section<'a>, key: &str, found: Found<&Item>, span: Span) -> Option<f64> {
        let Some(value) = number_in(found.value) else {
            let advice = match found.value.as_str() {
                Some(text) if text.trim().parse::<f64>().is_ok() => "take the quotes away".into(),
                _ => format!("write a plain number in {}", if span.unit.is_empty() { "digits" } else { span.unit }),
            };
            self.wrong_type(section, key, found, &span.expected(), advice);
            return None;
        };
        if !span.takes(value) {
            let advice = span.advice(value);
            self.fault_in(section, key, found.line, &value.to_string(), &span.expected(), advice);
            return None;
        }
        Some(value)
    }

    /// A number within `span`; a fault where the key is missing.
    pub(super) fn required_number(&self, section: Section<'a>, key: &str, span: Span) -> Option<Found<f64>> {
        if self.lookup(section, key).is_none() {
            self.missing(section, key, &span.expected());
        }
        self.number(section, key, span)
    }

    /// A whole number within `span`; a fault where the key is missing.
    pub(super) fn required_integer(&self, section: Section<'a>, key: &str, span: Span) -> Option<Found<usize>> {
        let found = self.required_number(section, key, span)?;
        if found.value.fract() != 0.0 {
            let advice = "write it without a fraction".into();
            self.fault_in(section, key, found.line, &found.value.to_string(), "a whole number", advice);
            return None;
        }
        Some(Found { value: found.value as usize, line: found.line })
    }

    /// A number for each colour within `span`; `required` says which colours may not be left out.
    pub(super) fn numbers(
        &self,
        section: Section<'a>,
        key: &str,
        span: Span,
        required: PerColour<bool>,
    ) -> PerColour<Option<Found<f64>>> {
        let given = self.lookup(section, key).map(|found| found.value);
        let advice = given.and_then(|given| span.for_each_colour(given)).unwrap_or_else(|| each_colour(["..."; 3]));
        let items = self.colours(section, key, &span.expected(), required, &advice);
        PerColour(Colour::ALL.map(|colour| {
            let found = items[colour]?;
            let value = self.number_of(section, &format!("{key}.{colour}"), found, span)?;
            Some(Found { value, line: found.line })
        }))
    }

    /// A text for each colour, none required.
    pub(super) fn texts(&self, section: Section<'a>, key: &str, expected: &str) -> PerColour<Option<Found<&'a str>>> {
        let advice = each_colour(["\"red.file\"", "\"green.file\"", "\"blue.file\""]);
        let items = self.colours(section, key, expected, PerColour([false; 3]), &advice);
        PerColour(Colour::ALL.map(|colour| {
            let found = items[colour]?;
            self.text_of(section, &format!("{key}.{colour}"), found, expected)
        }))
    }

    fn colours(
        &self,
        section: Section<'a>,
        key: &str,
        expected: &str,
        required: PerColour<bool>,
        advice: &str,
    ) -> PerColour<Option<Found<&'a Item>>> {
        const NONE: PerColour<Option<Found<&Item>>> = PerColour([None; 3]);
        let Some(found) = self.lookup(section, key) else {
            if required.0.contains(&true) {
                self.missing(section, key, &format!("{expected} for each colour"));
            }
            return NONE;
        };
        let Some(table) = found.value.as_table_like() else {
            self.wrong_type(section, key, found, &format!("{expected} for each colour"), advice.into());
            return NONE;
        };
        let names = Colour::ALL.map(Colour::name);
        for (name, item) in table.iter().filter(|(name, _)| !names.contains(name)) {
            let line = found.line.map(|line| self.source.line_of(item.span()).unwrap_or(line));
            let advice = did_you_mean(name, &names).unwrap_or("take it out".into());
            self.fault_in(section, &format!("{key}.{name}"), line, "an unknown key", "one of red, green, blue", advice);
        }
        PerColour(Colour::ALL.map(|colour| {
            let item = table.get(colour.name());
            if item.is_none() && required[colour] {
                let path = format!("{key}.{colour}");
                self.fault_in(section, &path, found.line, "nothing", expected, format!("add {colour} to {key}"));
            }
            item.map(|item| Found {
                value: item,
                line: found.line.map(|line| self.source.line_of(item.span()).unwrap_or(line)),
            })
        }))
    }

    /// A text that is not empty, where the key is there.
    pub(super) fn text(&self, section: Section<'a>, key: &str, expected: &str) -> Option<Found<&'a str>> {
        let found = self.lookup(section, key)?;
        self.text_of(section, key, found, expected)
    }

    /// A text that is not empty; a fault where the key is missing.
    pub(super) fn required_text(&self, section: Section<'a>, key: &str, expected: &str) -> Option<Found<&'a str>> {
        if self.lookup(section, key).is_none() {
            self.missing(section, key, expected);
        }
        self.text(section, key, expected)
    }

    /// A text of any characters; a fault where the key is missing.
    pub(super) fn required_raw_text(&self, section: Section<'a>, key: &str, expected: &str) -> Option<Found<&'a str>> {
        let Some(found) = self.lookup(section, key) else {
            self.missing(section, key, expected);
            return None;
        };
        let Some(text) = found.value.as_str() else {
            self.wrong_type(section, key, found, expected, "write it in double quotes".into());
            return None;
        };
        Some(Found { value: text, line: found.line })
    }

    /// A list of texts that are not empty; an empty list where the key is missing and not required.
    pub(super) fn text_list(
        &self,
        section: Section<'a>,
        key: &str,
        required: bool,
        count_max: usize,
    ) -> Option<Found<Vec<&'a str>>> {
        let expected = format!("a list of {} to {count_max} texts", usize::from(required));
        let Some(found) = self.lookup(section, key) else {
            if required {
                self.missing(section, key, &expected);
                return None;
            }
            return Some(Found { value: Vec::new(), line: None });
        };
        let Some(array) = found.value.as_array() else {
            self.wrong_type(section, key, found, &expected, "write the texts in square brackets".into());
            return None;
        };
        let texts: Option<Vec<&str>> = array.iter().map(|item| item.as_str().filter(|text| !text.is_empty())).collect();
        match texts {
            Some(texts) if texts.len() <= count_max && !(required && texts.is_empty()) => {
                Some(Found { value: texts, line: found.line })
            }
            Some(texts) => {
                let advice = if texts.is_empty() { "write at least one" } else { "write fewer" };
                self.fault_in(section, key, found.line, &format!("{} texts", texts.len()), &expected, advice.into());
                None
            }
            None => {
                self.wrong_type(section, key, found, &expected, "write each text in double quotes, none empty".into());
                None
            }
        }
    }

    /// The tables `[[name]]`, at most `count_max` of them.
    pub(super) fn sections(&self, root: Section<'a>, name: &'static str, count_max: usize) -> Option<Vec<Section<'a>>> {
        let Some(found) = self.lookup(root, name) else { return Some(Vec::new()) };
        let Some(tables) = found.value.as_array_of_tables().filter(|tables| tables.len() <= count_max) else {
            let expected = format!("1 to {count_max} tables");
            self.wrong_type(root, name, found, &expected, format!("begin each table with a line [[{name}]]"));
            return None;
        };
        let section = |table: &'a Table| Section {
            name,
            table: Some(table as &dyn TableLike),
            line: self.source.line_of(table.span()),
            profile: None,
            excused: &[],
        };
        Some(tables.iter().map(section).collect())
    }

    fn text_of(
        &self,
        section: Section<'a>,
        key: &str,
        found: Found<&'a Item>,
        expected: &str,
    ) -> Option<Found<&'a str>> {
        match found.value.as_str() {
            Some(text) if !text.trim().is_empty() && !text.contains('\0') => {
                Some(Found { value: text, line: found.line })
            }
            Some(text) => {
                let (is, advice) = match text.contains('\0') {
                    true => ("a text with a NUL character", "take that out"),
                    false => ("an empty text", "fill it in or take it out"),
                };
                self.fault_in(section, key, found.line, is, expected, advice.into());
                None
            }
            None => {
                self.wrong_type(section, key, found, expected, "write it in double quotes".into());
                None
            }
        }
    }

    /// What was read from the file that `key` names; its fault becomes the key's.
    pub(super) fn of_file<T>(
        &self,
        section: Section<'a>,
        key: &str,
        line: Option<usize>,
        read: Result<T, FileFault>,
    ) -> Option<T> {
        read.map_err(|fault| self.fault_in(section, key, line, &fault.found, &fault.expected, fault.advice)).ok()
    }

    /// true or false; `default` where the key is missing.
    pub(super) fn flag(&self, section: Section<'a>, key: &str, default: bool) -> bool {
        let Some(found) = self.lookup(section, key) else { return default };
        found.value.as_bool().unwrap_or_else(|| {
            self.wrong_type(section, key, found, "true or false", "write true or false, without quotes".into());
            default
        })
    }

    /// One of the named choices; a fault where the key is missing and `required`.
    pub(super) fn choice<T: Clone>(
        &self,
        section: Section<'a>,
        key: &str,
        choices: &[(&'static str, T)],
        required: bool,
    ) -> Option<Found<T>> {
        let expected =
            format!("one of {}", choices.iter().map(|(name, _)| format!("\"{name}\"")).collect::<Vec<_>>().join(", "));
        if self.lookup(section, key).is_none() && required {
            self.missing(section, key, &expected);
        }
        let text = self.text(section, key, &expected)?;
        let choice = choices.iter().find(|(name, _)| *name == text.value);
        if choice.is_none() {
            let names: Vec<&str> = choices.iter().map(|(name, _)| *name).collect();
            let advice =
                nearest(text.value, &names).map_or("choose one".into(), |name| format!("did you mean \"{name}\"?"));
            self.fault_in(section, key, text.line, &format!("{:?}", text.value), &expected, advice);
        }
        choice.map(|(_, value)| Found { value: value.clone(), line: text.line })
    }

    /// The order of the colours: each of the three once.
    pub(super) fn colour_order(&self, section: Section<'a>, key: &str) -> Option<[Colour; 3]> {
        const EXPECTED: &str = "red, green and blue, each once";
        let Some(found) = self.lookup(section, key) else {
            self.missing(section, key, EXPECTED);
            return None;
        };
        let names: Option<Vec<&str>> =
            found.value.as_array().and_then(|array| array.iter().map(|v| v.as_str()).collect());
        let order: Option<Vec<Colour>> = names.and_then(|names| {
            names.iter().map(|name| Colour::ALL.into_iter().find(|colour| colour.name() == *name)).collect()
        });
        match order.and_then(|order| <[Colour; 3]>::try_from(order).ok()) {
            Some(order) if Colour::ALL.iter().all(|colour| order.contains(colour)) => Some(order),
            _ => {
                let advice = format!("write for example {key} = [\"red\", \"green\", \"blue\"]");
                self.wrong_type(section, key, found, EXPECTED, advice);
                None
            }
        }
    }
}

/// The number that `item` gives: an integer, a float, or the text "inf".
fn number_in(item: &Item) -> Option<f64> {
    item.as_value().and_then(number_of_value)
}

fn number_of_value(value: &Value) -> Option<f64> {
    value.as_float().or_else(|| value.as_integer().map(|integer| integer as f64)).or_else(|| match value.as_str() {
        Some("inf" | "infinity") => Some(f64::INFINITY),
        _ => None,
    })
}
