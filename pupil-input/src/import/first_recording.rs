//! Exports of several recordings in one file: the first is read.

use super::recording::LogBuilder;

/// Tells the rows of a file's first recording from those of others, by `N` columns that name a recording.
pub(super) struct FirstRecording<const N: usize> {
    /// What the columns are, for people.
    columns: [&'static str; N],
    first: Option<[Vec<u8>; N]>,
    of_others: u64,
}

impl<const N: usize> FirstRecording<N> {
    pub(super) const fn new(columns: [&'static str; N]) -> Self {
        Self { columns, first: None, of_others: 0 }
    }

    /// Whether a row with these cells is of the first recording; counts it if not.
    pub(super) fn has(&mut self, cells: [&[u8]; N]) -> bool {
        let first = self.first.get_or_insert_with(|| cells.map(<[u8]>::to_vec));
        let is_of_first = first.iter().zip(cells).all(|(first, this)| first == this);
        self.of_others += u64::from(!is_of_first);
        is_of_first
    }

    pub(super) fn note(self, log: &mut LogBuilder) {
        let Some(first) = self.first.filter(|_| self.of_others > 0) else { return };
        let named =
            |(column, name): (&str, Vec<u8>)| format!("{column} `{}`", String::from_utf8_lossy(&name).escape_debug());
        let names: Vec<_> = self.columns.into_iter().zip(first).map(named).collect();
        log.warn(format!(
            "the file holds several recordings; only the first was read ({}), and {} rows of others were left out; \
             export each into a file of its own to read it",
            names.join(", "),
            self.of_others
        ));
    }
}
