//! Kinds of values that only rig files have: figures in a unit, and values for each colour.

use toml_edit::{Item, Value};

use super::files::FileFault;
use crate::toml_reader::{Found, Section};
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

    /// Takes infinity, too, as a number or as the text "inf".
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

impl<T> Found<'_, T> {
    /// What was read from the file that is named here; the file's fault becomes the key's.
    pub(super) fn of_file<U>(&self, read: Result<U, FileFault>) -> Option<U> {
        read.map_err(|fault| self.fault(fault.found, &fault.expected, fault.advice)).ok()
    }
}

impl Found<'_, &Item> {
    /// A number within `span`.
    fn number_in(&self, span: Span) -> Option<f64> {
        let expected = span.expected();
        let Some(value) = number_in(self.value) else {
            let advice = match self.value.as_str() {
                Some(text) if text.trim().parse::<f64>().is_ok() => "take the quotes away".into(),
                _ => format!("write a plain number in {}", if span.unit.is_empty() { "digits" } else { span.unit }),
            };
            self.wrong_type(&expected, advice);
            return None;
        };
        if !span.takes(value) {
            self.fault(value, &expected, span.advice(value));
        }
        span.takes(value).then_some(value)
    }
}

impl<'a> Section<'a> {
    /// A number within `span`, where the key is there.
    pub(super) fn number(&self, key: &'static str, span: Span) -> Option<Found<'a, f64>> {
        let found = self.get(key)?;
        Some(found.with(found.number_in(span)?))
    }

    /// A number within `span`; a fault where the key is missing.
    pub(super) fn required_number(&self, key: &'static str, span: Span) -> Option<Found<'a, f64>> {
        let found = self.require(key, &span.expected())?;
        Some(found.with(found.number_in(span)?))
    }

    /// A whole number within `span`; a fault where the key is missing.
    pub(super) fn required_integer(&self, key: &'static str, span: Span) -> Option<Found<'a, usize>> {
        let found = self.required_number(key, span)?;
        if found.value.fract() != 0.0 {
            found.fault(found.value, "a whole number", "write it without a fraction");
            return None;
        }
        Some(found.with(found.value as usize))
    }

    /// A number for each colour within `span`; `required` says which colours may not be left out.
    pub(super) fn numbers(
        &self,
        key: &'static str,
        span: Span,
        required: PerColour<bool>,
    ) -> PerColour<Option<Found<'a, f64>>> {
        let given = self.get(key).and_then(|given| span.for_each_colour(given.value));
        let advice = given.unwrap_or_else(|| each_colour(["..."; 3]));
        let items = self.colours(key, &span.expected(), required, advice);
        items.map(|item| item.and_then(|found| Some(found.with(found.number_in(span)?))))
    }

    /// A text for each colour, none required.
    pub(super) fn texts(&self, key: &'static str, expected: &str) -> PerColour<Option<Found<'a, &'a str>>> {
        let advice = each_colour(["\"red.file\"", "\"green.file\"", "\"blue.file\""]);
        let items = self.colours(key, expected, PerColour([false; 3]), advice);
        items.map(|item| item.and_then(|found| Some(found.with(found.text(expected)?))))
    }

    fn colours(
        &self,
        key: &'static str,
        expected: &str,
        required: PerColour<bool>,
        advice: String,
    ) -> PerColour<Option<Found<'a, &'a Item>>> {
        let for_each = format!("{expected} for each colour");
        let found = match required.0.contains(&true) {
            true => self.require(key, &for_each),
            false => self.get(key),
        };
        let Some(found) = found else { return PerColour([const { None }; 3]) };
        let table = found.table_or(&for_each, advice);
        table.reject_unknown(&Colour::ALL.map(Colour::name), |_| None);
        PerColour(Colour::ALL.map(|colour| {
            let item = table.get(colour.name());
            if item.is_none() && table.is_there() && required[colour] {
                table.fault_at(colour.name(), None, "nothing", expected, format!("add {colour} to {key}"));
            }
            item
        }))
    }

    /// A list of texts that are not empty; an empty list where the key is missing and not required.
    pub(super) fn text_list(
        &self,
        key: &'static str,
        required: bool,
        count_max: usize,
    ) -> Option<Found<'a, Vec<&'a str>>> {
        let expected = format!("a list of {} to {count_max} texts", usize::from(required));
        if !required && !self.has(key) {
            return Some(self.assumed(key, Vec::new()));
        }
        let found = self.require(key, &expected)?;
        let Some(array) = found.value.as_array() else {
            found.wrong_type(&expected, "write the texts in square brackets");
            return None;
        };
        let texts: Option<Vec<&str>> = array.iter().map(|item| item.as_str().filter(|text| !text.is_empty())).collect();
        match texts {
            Some(texts) if texts.len() <= count_max && !(required && texts.is_empty()) => {
                return Some(found.with(texts));
            }
            Some(texts) => {
                let advice = if texts.is_empty() { "write at least one" } else { "write fewer" };
                found.fault(format!("{} texts", texts.len()), &expected, advice);
            }
            None => found.wrong_type(&expected, "write each text in double quotes, none empty"),
        }
        None
    }

    /// The order of the colours: each of the three once.
    pub(super) fn colour_order(&self, key: &'static str) -> Option<[Colour; 3]> {
        const EXPECTED: &str = "red, green and blue, each once";
        let found = self.require(key, EXPECTED)?;
        let names = found.value.as_array().map(|array| array.iter().map(Value::as_str));
        let order: Option<Vec<Colour>> = names.and_then(|names| {
            names.map(|name| Colour::ALL.into_iter().find(|colour| Some(colour.name()) == name)).collect()
        });
        let order = order.and_then(|order| <[Colour; 3]>::try_from(order).ok());
        let order = order.filter(|order| Colour::ALL.iter().all(|colour| order.contains(colour)));
        if order.is_none() {
            found.wrong_type(EXPECTED, format!("write for example {key} = [\"red\", \"green\", \"blue\"]"));
        }
        order
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
