//! Bytes that are held until they can be read.

/// A buffer of a fixed size, which is allocated when it is made.
#[derive(Clone, Debug)]
pub(super) struct Buffer {
    bytes: Box<[u8]>,
    used: usize,
}

impl Buffer {
    /// An empty one of `size` bytes.
    pub(super) fn new(size: usize) -> Self {
        Self { bytes: vec![0; size].into_boxed_slice(), used: 0 }
    }

    /// Takes as many of `bytes` as there is room for; gives the others.
    pub(super) fn fill<'a>(&mut self, bytes: &'a [u8]) -> &'a [u8] {
        let room = &mut self.bytes[self.used..];
        let (taken, others) = bytes.split_at(bytes.len().min(room.len()));
        room[..taken.len()].copy_from_slice(taken);
        self.used += taken.len();
        others
    }

    pub(super) fn held(&self) -> &[u8] {
        &self.bytes[..self.used]
    }

    /// Drops the first `count` bytes.
    pub(super) fn drop_front(&mut self, count: usize) {
        self.bytes.copy_within(count..self.used, 0);
        self.used -= count;
    }

    pub(super) const fn clear(&mut self) {
        self.used = 0;
    }
}

/// The beginning of a text, as much of it as a buffer takes.
#[derive(Clone, Debug)]
pub(super) struct Beginning {
    buffer: Buffer,
    /// Whether the text is longer than what the buffer takes.
    pub(super) overlong: bool,
}

impl Beginning {
    /// None yet, of at most `size` bytes.
    pub(super) fn new(size: usize) -> Self {
        Self { buffer: Buffer::new(size), overlong: false }
    }

    pub(super) fn push(&mut self, bytes: &[u8]) {
        self.overlong |= !self.buffer.fill(bytes).is_empty();
    }

    pub(super) fn bytes(&self) -> &[u8] {
        self.buffer.held()
    }

    pub(super) const fn clear(&mut self) {
        self.buffer.clear();
        self.overlong = false;
    }
}
