//! holod as a process, in one test program, which is linked once. `fail_dark`, which measures, has its own.

mod bad_input;
mod bench;
mod control;
mod evaluate;
mod faults;
mod feed;
mod focal_stack;
mod gpu;
mod inspect;
mod lut;
mod page;
mod panel;
mod pattern;
mod pictures;
mod record;
mod render;
mod report;
mod shutdown;
mod sleep;
mod tracker;

const HOLOD: &str = env!("CARGO_BIN_EXE_holod");

/// Tests each case, all at once: what takes long waits.
fn beside_each_other<T: Send>(cases: impl IntoIterator<Item = T>, test: impl Fn(T) + Sync) {
    let test = &test;
    std::thread::scope(|scope| {
        for case in cases {
            scope.spawn(move || test(case));
        }
    });
}
