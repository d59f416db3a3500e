//! Bytes that a profile gives.

use holod_calibration::toml_reader::Found;
use toml_edit::Item;

/// A text, each character of which is one byte, or an array of numbers.
pub(super) fn read_bytes(found: &Found<'_, &Item>) -> Option<Vec<u8>> {
    const EXPECTED: &str = "bytes: a text such as \"Go\\r\\n\", or numbers such as [0x80, 0x81]";
    if let Some(text) = found.value.as_str() {
        return unescape(text).map_err(|problem| found.fault(format!("{text:?}"), EXPECTED, problem)).ok();
    }
    let numbers = found.value.as_array().map(|array| array.iter().map(|value| value.as_integer()?.try_into().ok()));
    let bytes = numbers.and_then(|numbers| numbers.collect::<Option<Vec<u8>>>());
    if bytes.is_none() {
        found.wrong_type(EXPECTED, "each number is one byte, 0 to 255");
    }
    bytes
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
