//! `kind = "delimited"`: lines of columns.

use holod_calibration::toml_reader::{Found, Section, did_you_mean};
use toml_edit::Item;

use super::checksum::read_checksum_kind;
use super::context::Context;
use super::layout::{Places, read_layout};
use crate::profile::bytes::read_bytes;
use crate::wire::delimited::{Column, DelimitedSettings, MAX_COLUMNS, Separator};

struct ColumnPlaces {
    /// The names that the profile gives.
    columns: Vec<String>,
}

impl ColumnPlaces {
    fn column(&self, found: &Found<'_, &Item>) -> Option<Column> {
        const EXPECTED: &str = "a column: its number from 1, or its name in quotes";
        let Some(name) = found.value.as_str() else {
            return match found.value.as_integer() {
                Some(_) => found.integer(1..=MAX_COLUMNS as i64).map(|number| Column::Number(number as usize)),
                None => {
                    found.fault(found.value.to_string().trim(), EXPECTED, "correct it");
                    None
                }
            };
        };
        if !self.columns.is_empty() && !self.columns.iter().any(|known| known == name) {
            let names: Vec<_> = self.columns.iter().map(String::as_str).collect();
            let expected = format!("one of wire.columns: {}", names.join(", "));
            found.fault(format!("{name:?}"), &expected, did_you_mean(name, &names).unwrap_or("correct it".into()));
            return None;
        }
        Some(Column::Name(name.into()))
    }
}

impl<'a> Places<'a> for ColumnPlaces {
    type Place = Column;

    fn bare(&self, found: &Found<'a, &'a Item>) -> Option<Option<Column>> {
        found.value.as_table_like().is_none().then(|| self.column(found))
    }

    fn read(&self, table: &Section<'a>) -> Option<Column> {
        self.column(&table.require("column", "a column: its number from 1, or its name in quotes")?)
    }

    fn wrap_bits(&self, _: &Column) -> Option<u32> {
        None
    }

    fn texts(&self) -> bool {
        true
    }

    fn same(&self, one: &Column, other: &Column) -> bool {
        one == other
    }
}

pub(super) fn read_delimited<'a>(wire: &Section<'a>, context: &Context<'_>) -> Option<DelimitedSettings> {
    let decimal_comma = wire.flag("decimal_comma", false);
    let separator = match wire.get("separator") {
        None => Some(Separator::Byte(b',')),
        Some(found) => read_separator(&found),
    };
    if let (Some(Separator::Byte(b',')), true) = (separator, decimal_comma) {
        let advice = "write separator = \";\" or whatever stands between the columns";
        wire.fault("a comma in numbers and between columns", "two different characters", advice);
    }
    let line_part = |key| {
        let found = wire.get(key)?;
        let bytes = read_bytes(&found)?;
        if bytes.len() > 64 || bytes.iter().any(|byte| matches!(byte, b'\r' | b'\n')) {
            found.fault(format!("{} bytes", bytes.len()), "up to 64 bytes without a line's end", "correct it");
        }
        Some(bytes)
    };
    let (prefix, comment) = (line_part("prefix").unwrap_or_default(), line_part("comment").unwrap_or(b"#".to_vec()));
    if !comment.is_empty()
        && prefix.starts_with(&comment)
        && let Some(found) = wire.get("prefix")
    {
        let sign = String::from_utf8_lossy(&comment).into_owned();
        let advice = "write comment = \"\" where there are none, or the sign of those that there are";
        found.fault(found.value.to_string().trim(), &format!("no comment: those begin with `{sign}`"), advice);
    }
    let columns = wire.get("columns").map_or(Vec::new(), |found| {
        const EXPECTED: &str = "the columns' names, each once, such as [\"time\", \"left_mm\"]";
        let items = found.items(EXPECTED);
        let names: Vec<_> = items.iter().filter_map(|item| item.value.as_str().map(str::to_owned)).collect();
        let twice = (1..names.len()).any(|index| names[..index].contains(&names[index]));
        if names.len() != items.len() || names.len() > MAX_COLUMNS || twice {
            found.fault(found.value.to_string().trim(), EXPECTED, "correct it");
        }
        names
    });
    let checksum = wire.get("checksum").and_then(|found| {
        let table = if found.value.is_str() { Section::empty(&found) } else { found.table() };
        let kind = if found.value.is_str() { Some(found.clone()) } else { table.require("kind", "a kind of checksum") };
        let kind = read_checksum_kind(&table, &kind?);
        let skip = table.integer("skip", 0..=64).unwrap_or(0) as usize;
        table.finish();
        Some((kind?, skip))
    });
    let layout = read_layout(&ColumnPlaces { columns: columns.clone() }, wire, context);
    Some(DelimitedSettings {
        separator: separator?,
        decimal_comma,
        prefix,
        comment,
        columns,
        checksum,
        layout: layout?,
    })
}

fn read_separator(found: &Found<'_, &Item>) -> Option<Separator> {
    const EXPECTED: &str = "one character such as \";\", or \"whitespace\"";
    let text = found.raw_text(EXPECTED)?;
    match *text.as_bytes() {
        [byte] if byte.is_ascii() && !byte.is_ascii_alphanumeric() && !b"-+.\"\r\n".contains(&byte) => {
            Some(Separator::Byte(byte))
        }
        _ if text == "whitespace" => Some(Separator::Whitespace),
        _ => {
            found.fault(format!("{text:?}"), EXPECTED, "no letter, digit, sign, point, quote or line's end");
            None
        }
    }
}
