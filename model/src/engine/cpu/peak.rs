//! The ceilings under which the kernels are judged: what the cores can multiply and add, and what their memory moves.

use std::fs;
use std::hint::black_box;
use std::path::Path;
use std::sync::{Barrier, OnceLock};
use std::time::{Duration, Instant};

use crate::simd::{InstructionSet, Products, Simd, Task};

/// How long each ceiling is measured, at least.
const MEASURED: Duration = Duration::from_millis(200);
/// Independent chains of multiply-adds: enough to hide the latency of two units on every processor in sight.
const CHAINS: usize = 12;
const STEPS_PER_ROUND: usize = 20_000;
/// How often both are timed to decide on half precision, and how many times faster it must be at least.
const HALF_ROUNDS: usize = 20;
const HALF_GAIN: f64 = 1.25;
/// How many times the last-level caches a stream's buffers are, within these limits.
const TIMES_CACHES: u64 = 4;
const STREAM_BYTES_MIN: u64 = 256 << 20;
const STREAM_BYTES_MAX: u64 = 1 << 30;
/// Of a stream, for each element: two are read and one is written back.
const BYTES_PER_STEP: usize = 3 * size_of::<f32>();
const CPUS: &str = "/sys/devices/system/cpu";

/// The multiply-add throughput in FLOP/s (two to a multiply-add) that `threads` threads reach together at this moment,
/// with the best instruction set and all operands in registers. Takes about a fifth of a second.
pub fn fma_peak(threads: usize) -> f64 {
    on_threads(threads, flop_per_s)
}

/// The bytes/s that `threads` threads read and write together at this moment, each with two buffers of its own, all of
/// them together beyond the last-level caches: a·½ + b is written back to a, so that nothing moves that is not counted.
/// Takes less than a second, and 256 MiB to 1 GiB of memory.
pub fn stream_bandwidth(threads: usize) -> f64 {
    let threads = threads.max(1);
    let caches = last_level_caches(Path::new(CPUS)).unwrap_or(0);
    let bytes = (TIMES_CACHES * caches).clamp(STREAM_BYTES_MIN, STREAM_BYTES_MAX);
    let elements = bytes as usize / (2 * size_of::<f32>()) / threads;
    let all_filled = Barrier::new(threads);
    on_threads(threads, || {
        let (mut a, b) = (vec![0.5; elements], vec![0.25; elements]);
        all_filled.wait();
        bytes_per_s(&mut a, &b)
    })
}

/// The sum of what `work` returns on each of `threads` threads.
fn on_threads(threads: usize, work: impl Fn() -> f64 + Sync) -> f64 {
    std::thread::scope(|scope| {
        let workers: Vec<_> = (0..threads.max(1)).map(|_| scope.spawn(&work)).collect();
        workers.into_iter().map(|worker| worker.join().expect("a measuring loop does not panic")).sum()
    })
}

/// How often a second this thread does `round`.
fn rounds_per_s(mut round: impl FnMut()) -> f64 {
    let began = Instant::now();
    let mut rounds = 0;
    while began.elapsed() < MEASURED {
        round();
        rounds += 1;
    }
    f64::from(rounds) / began.elapsed().as_secs_f64()
}

/// FLOP/s of this thread.
fn flop_per_s() -> f64 {
    let set = InstructionSet::best();
    let flop_per_round = STEPS_PER_ROUND * CHAINS * set.lanes() * 2;
    rounds_per_s(|| set.run(MultiplyAdds)) * flop_per_round as f64
}

/// Whether products of half precision are well faster here than those of single precision; measured once, in some
/// milliseconds. Of bfloat16s, processors do either twice as many in the same time or no more; of integers, 1.6 times as
/// many (Zen 3): product and sum are an instruction each.
pub(super) fn half_pays() -> bool {
    static PAYS: OnceLock<bool> = OnceLock::new();
    *PAYS.get_or_init(|| {
        let Some(half) = Products::half() else { return false };
        // Whatever else the machine does can only make a round longer.
        let shortest = |products: Products| {
            let round = || {
                let began = Instant::now();
                products.run(MultiplyAdds);
                began.elapsed()
            };
            (0..HALF_ROUNDS).map(|_| round()).min().unwrap_or_default() / products.factors() as u32
        };
        let [half, single] = [half, Products::Single(InstructionSet::best())].map(shortest);
        half.mul_f64(HALF_GAIN) < single
    })
}

/// Bytes/s of this thread.
fn bytes_per_s(a: &mut [f32], b: &[f32]) -> f64 {
    let set = InstructionSet::best();
    let bytes_per_round = a.len() * BYTES_PER_STEP;
    rounds_per_s(|| set.run(Stream { a: black_box(&mut *a), b: black_box(b) })) * bytes_per_round as f64
}

struct MultiplyAdds;

impl Task for MultiplyAdds {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let (factor, addend) = (simd.splat(black_box(0.999)), simd.splat(black_box(1e-3)));
        let mut chains = [simd.splat(black_box(1.0)); CHAINS];
        for _ in 0..STEPS_PER_ROUND {
            for chain in &mut chains {
                *chain = simd.mul_add_factors(*chain, factor, addend);
            }
        }
        black_box(chains);
    }
}

struct Stream<'a> {
    a: &'a mut [f32],
    b: &'a [f32],
}

impl Task for Stream<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        for (a, b) in self.a.iter_mut().zip(self.b) {
            *a = 0.5 * *a + b;
        }
    }
}

/// Bytes of the machine's last-level caches, each counted once; nothing where the system does not tell.
fn last_level_caches(cpus: &Path) -> Option<u64> {
    let mut caches = Vec::new();
    for cpu in fs::read_dir(cpus).ok()?.flatten() {
        let levels = fs::read_dir(cpu.path().join("cache")).into_iter().flatten().flatten();
        let of_level = |folder: &Path| {
            let read = |name| Some(fs::read_to_string(folder.join(name)).ok()?.trim().to_owned());
            Some((read("level")?.parse::<u32>().ok()?, read("shared_cpu_list")?, size_bytes(&read("size")?)?))
        };
        caches.extend(levels.filter_map(|level| of_level(&level.path())));
    }
    let last = caches.iter().map(|(level, ..)| *level).max()?;
    caches.retain(|(level, ..)| *level == last);
    caches.sort();
    caches.dedup();
    Some(caches.into_iter().map(|(.., bytes)| bytes).sum())
}

/// A size as sysfs writes it, such as `32768K`, in bytes.
fn size_bytes(text: &str) -> Option<u64> {
    let digits = text.trim_end_matches(['K', 'M', 'G']);
    let shift = match &text[digits.len()..] {
        "" => 0,
        "K" => 10,
        "M" => 20,
        "G" => 30,
        _ => return None,
    };
    digits.parse::<u64>().ok()?.checked_mul(1 << shift)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// FLOP/s of this thread in plain Rust, over as many chains of one number each.
    fn plain_flop_per_s() -> f64 {
        let (factor, addend) = (black_box(0.999_f32), black_box(1e-3_f32));
        let round = || {
            let mut chains = black_box([1.0_f32; CHAINS]);
            for _ in 0..STEPS_PER_ROUND {
                for chain in &mut chains {
                    *chain = *chain * factor + addend;
                }
            }
            black_box(chains);
        };
        rounds_per_s(round) * (STEPS_PER_ROUND * CHAINS * 2) as f64
    }

    #[test]
    fn there_are_ceilings_and_no_plain_loop_is_above_them() {
        for bandwidth in [stream_bandwidth(1), stream_bandwidth(2)] {
            assert!(bandwidth.is_finite() && bandwidth > 1e6, "{bandwidth}");
        }
        // By turns, the best of each: whatever else the machine does can only make either slower.
        let (mut peak, mut plain) = (0.0_f64, 0.0_f64);
        for _ in 0..4 {
            (peak, plain) = (peak.max(fma_peak(1)), plain.max(plain_flop_per_s()));
        }
        assert!(peak.is_finite() && peak >= plain, "{peak} FLOP/s, and {plain} in a plain loop");
    }

    #[test]
    fn a_stream_updates_every_element() {
        let (mut a, b) = (vec![0.0; 37], vec![1.0; 37]);
        InstructionSet::best().run(Stream { a: &mut a, b: &b });
        InstructionSet::best().run(Stream { a: &mut a, b: &b });
        assert_eq!(a, vec![1.5; 37]);
    }

    #[test]
    fn last_level_caches_are_counted_once_each() {
        let cpus = tempfile::tempdir().unwrap();
        // Two processors of two cores: each core's own second level, each processor's third.
        for cpu in 0..4 {
            let pair = ["0-1", "2-3"][cpu / 2];
            for (index, level, size, shared) in [(0, "2", "1024K", cpu.to_string()), (1, "3", "32M", pair.to_owned())] {
                let folder = cpus.path().join(format!("cpu{cpu}/cache/index{index}"));
                fs::create_dir_all(&folder).unwrap();
                for (name, text) in [("level", level), ("size", size), ("shared_cpu_list", &shared)] {
                    fs::write(folder.join(name), format!("{text}\n")).unwrap();
                }
            }
        }
        fs::create_dir(cpus.path().join("cpufreq")).unwrap();
        assert_eq!(last_level_caches(cpus.path()), Some(64 << 20));
        fs::write(cpus.path().join("cpu3/cache/index1/size"), "much").unwrap();
        assert_eq!(last_level_caches(cpus.path()), Some(64 << 20), "the other core's word of it is enough");
        assert_eq!(last_level_caches(&cpus.path().join("cpufreq")), None);
    }
}
