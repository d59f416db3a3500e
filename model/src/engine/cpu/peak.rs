//! The multiply-add throughput against which the kernels are judged.

use std::hint::black_box;
use std::time::{Duration, Instant};

use crate::simd::{InstructionSet, Simd, Task};

/// Independent chains of multiply-adds: enough to hide the latency of two units on every processor in sight.
const CHAINS: usize = 12;
const STEPS_PER_ROUND: usize = 20_000;

/// The multiply-add throughput in FLOP/s (two to a multiply-add) that `threads` threads reach together at this moment,
/// with the best instruction set and all operands in registers. Takes about a fifth of a second.
pub fn fma_peak(threads: usize) -> f64 {
    std::thread::scope(|scope| {
        let workers: Vec<_> = (0..threads.max(1)).map(|_| scope.spawn(one_thread)).collect();
        workers.into_iter().map(|worker| worker.join().expect("the peak loop does not panic")).sum()
    })
}

/// FLOP/s of this thread.
fn one_thread() -> f64 {
    let set = InstructionSet::best();
    let begin = Instant::now();
    let mut rounds = 0;
    while begin.elapsed() < Duration::from_millis(200) {
        set.run(Round);
        rounds += 1;
    }
    let flop = rounds * STEPS_PER_ROUND * CHAINS * set.lanes() * 2;
    flop as f64 / begin.elapsed().as_secs_f64()
}

struct Round;

impl Task for Round {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let (factor, addend) = (simd.splat(black_box(0.999)), simd.splat(black_box(1e-3)));
        let mut chains = [simd.splat(black_box(1.0)); CHAINS];
        for _ in 0..STEPS_PER_ROUND {
            for chain in &mut chains {
                *chain = simd.mul_add(*chain, factor, addend);
            }
        }
        black_box(chains);
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn there_is_a_peak() {
        let peak = super::fma_peak(1);
        assert!(peak.is_finite() && peak > 1e6, "{peak}");
    }
}
