//! Cells of a line of text, with and without quotation marks around them.

/// Which of tab, semicolon and comma parts the cells of `header`: the most frequent.
pub(crate) fn separator(header: &[u8]) -> u8 {
    let count = |separator: u8| memchr::memchr_iter(separator, header).count();
    b"\t;,".iter().copied().max_by_key(|separator| (count(*separator), *separator == b'\t')).unwrap_or(b',')
}

/// `line` cut at `separator`, the cells trimmed and without quotes around them. In a line with quotes, separators
/// between two of them do not count, except in a line of tabs, where quotes are text.
pub(crate) fn cells(line: &[u8], separator: u8) -> impl Iterator<Item = &[u8]> {
    let mut rest = Some(line);
    let quoted = separator != b'\t' && memchr::memchr(b'"', line).is_some();
    std::iter::from_fn(move || {
        let line = rest?;
        let end = if quoted {
            let mut within = false;
            line.iter().position(|&byte| {
                within ^= byte == b'"';
                byte == separator && !within
            })
        } else {
            memchr::memchr(separator, line)
        };
        rest = end.map(|end| &line[end + 1..]);
        Some(unquoted(&line[..end.unwrap_or(line.len())]))
    })
}

/// The first cell, trimmed and without quotes around it, and what comes after its separator.
pub(crate) fn first_cell(line: &[u8], separator: u8) -> (&[u8], Option<&[u8]>) {
    let end = cell_end(line, separator);
    (unquoted(&line[..end]), line.get(end + 1..))
}

/// What comes after the first cell's separator.
pub(crate) fn after_cell(line: &[u8], separator: u8) -> Option<&[u8]> {
    line.get(cell_end(line, separator) + 1..)
}

fn cell_end(line: &[u8], separator: u8) -> usize {
    let quoted =
        if line.first() == Some(&b'"') { memchr::memchr(b'"', &line[1..]).map_or(0, |closing| closing + 2) } else { 0 };
    memchr::memchr(separator, &line[quoted..]).map_or(line.len(), |length| quoted + length)
}

/// Whether a line that is not empty has fewer cells than `columns`.
pub(crate) fn has_fewer(line: &[u8], separator: u8, columns: usize) -> bool {
    let mut cells = 0;
    let mut rest = Some(line).filter(|line| !line.trim_ascii().is_empty());
    while let Some(line) = rest
        && cells < columns
    {
        rest = after_cell(line, separator);
        cells += 1;
    }
    (1..columns).contains(&cells)
}

/// Whether a cell behind the first `columns` of a line holds anything.
pub(crate) fn has_more(line: &[u8], separator: u8, columns: usize) -> bool {
    // Most lines have fewer separators, within quotes or not.
    memchr::memchr_iter(separator, line).nth(columns.saturating_sub(1)).is_some()
        && cells(line, separator).skip(columns).any(|cell| !cell.is_empty())
}

/// A cell, trimmed and without quotes around it.
pub(crate) fn unquoted(cell: &[u8]) -> &[u8] {
    let cell = cell.trim_ascii();
    cell.strip_prefix(b"\"").and_then(|cell| cell.strip_suffix(b"\"")).unwrap_or(cell)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_cut_at_the_separator_and_not_within_quotes() {
        let cut = |line: &'static str, separator| -> Vec<_> { cells(line.as_bytes(), separator).collect() };
        assert_eq!(cut("a, \"b,c\" ,,\"d\"\"e\"", b','), [&b"a"[..], b"b,c", b"", b"d\"\"e"]);
        assert_eq!(cut("a\t\"b\tc\"", b'\t'), [&b"a"[..], b"\"b", b"c\""]);
        assert_eq!(cut("\"a;b", b';'), [b"\"a;b"]);
        assert_eq!([separator(b"a,b\tc\td"), separator(b"a;b;c,d"), separator(b"a")], [b'\t', b';', b'\t']);
    }

    #[test]
    fn cells_behind_the_columns_count_where_they_hold_something() {
        let cases = [
            ("1,2", false),
            ("1,2,", false),
            ("1,2, ,\"\"", false),
            ("1,\"2,5\"", false),
            ("1,2,5", true),
            ("1,2,,5", true),
            ("\"1,5\",2,5", true),
            ("", false),
        ];
        for (line, more) in cases {
            assert_eq!(has_more(line.as_bytes(), b',', 2), more, "{line}");
        }
    }
}
