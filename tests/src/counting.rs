//! The system's allocator, counting.
//!
//! Only a global allocator sees every allocation, and one cannot be written without `unsafe`. A program that counts
//! makes it its own:
//!
//! ```
//! use holod_tests::counting::{self, Counting};
//!
//! #[global_allocator]
//! static COUNTING: Counting = Counting;
//!
//! let before = counting::here();
//! drop(std::hint::black_box(Box::new(1)));
//! assert_eq!(counting::here() - before, 1);
//! ```

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::atomic::{AtomicU64, Ordering};

/// The system's allocator; reallocations count as allocations.
#[derive(Debug)]
pub struct Counting;

thread_local! {
    static HERE: Cell<u64> = const { Cell::new(0) };
}
static EVERYWHERE: AtomicU64 = AtomicU64::new(0);

// SAFETY: every call is passed on to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        HERE.set(HERE.get() + 1);
        EVERYWHERE.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's promises are passed on.
        unsafe { System.dealloc(pointer, layout) }
    }
}

/// Allocations of the calling thread.
pub fn here() -> u64 {
    HERE.get()
}

/// Allocations of all threads.
pub fn everywhere() -> u64 {
    EVERYWHERE.load(Ordering::Relaxed)
}

/// Allocations of all other threads.
pub fn elsewhere() -> u64 {
    everywhere() - here()
}
