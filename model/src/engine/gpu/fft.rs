//! Circular transforms of lines of samples in a workgroup's memory, for `fft.wgsl`.

use std::f64::consts::{PI, TAU};
use std::fmt::Write;
use std::sync::Arc;

use holod_fft::{FftDirection, Real};
use num_complex::{Complex32, Complex64};

use super::plan::{BufferId, Constant, Plan, Shader};
use crate::gpu::GpuError;

/// Radices of the passes, in the order in which they are taken: odd strides spread a pass's stores over the banks of a
/// workgroup's memory.
const RADICES: [usize; 7] = [13, 11, 7, 5, 3, 2, 4];
/// The first of these, whose passes are written out by [`prime_pass`]; what chirps are transformed over does without.
const PRIMES: usize = 3;
/// Bytes of a sample.
const SAMPLE_BYTES: usize = size_of::<Complex32>();
/// Neighbouring columns of this many fill a line of a cache.
const MOST_LINES: usize = 8;
/// More of the memory of workgroups than this for one leaves too few beside it.
const MOST_BYTES: usize = 32 << 10;
/// The same of threads.
const MOST_THREADS: usize = 512;
/// Threads come in whole multiples of this.
const WAVE: usize = 64;
/// Samples of short rows that one workgroup takes.
const SAMPLES_OF_ROWS: usize = 1024;

/// What a device lets one workgroup have.
#[derive(Clone, Copy, Debug)]
pub(crate) struct WorkgroupLimits {
    /// Memory that its threads share.
    pub(crate) bytes: u32,
    /// Threads, all along x.
    pub(crate) threads: u32,
}

/// Transforms of lines of one length.
#[derive(Clone)]
pub(crate) struct LineFft {
    length: usize,
    /// What the passes go over: the length, or where that has other factors than theirs, what its chirps need.
    span: usize,
    radices: Vec<usize>,
    /// `turns` of `fft.wgsl`.
    turns: BufferId,
    limits: WorkgroupLimits,
}

impl LineFft {
    /// For lines of `length` samples, on a device with these `limits`.
    ///
    /// # Errors
    /// Not even one such line fits in a workgroup.
    pub(crate) fn new(plan: &mut Plan, length: usize, limits: WorkgroupLimits) -> Result<Self, GpuError> {
        let (span, radices) = match radices(length, &RADICES) {
            Some(radices) => (length, radices),
            None => {
                let of_small = |span| Some((span, radices(span, &RADICES[PRIMES..])?));
                (2 * length - 1..).find_map(of_small).expect("powers of 2 are")
            }
        };
        let bytes = span * SAMPLE_BYTES;
        if bytes > limits.bytes as usize {
            return Err(GpuError::LineTooLong { samples: length, bytes, limit: limits.bytes as usize });
        }
        let mut turns: Vec<_> = (0..span).map(|turn| Complex64::cis(-TAU * turn as f64 / span as f64)).collect();
        if span != length {
            turns.extend(chirps(length));
            turns.extend(chirp_spectrum(length, span));
        }
        let turns: Vec<_> = turns.iter().map(|turn| [turn.re as f32, turn.im as f32]).collect();
        let turns = plan.table("turns of a transform", &turns);
        Ok(Self { length, span, radices, turns, limits })
    }

    /// Workgroups for rows, whose threads hold `items` samples, or more where there are not threads enough.
    pub(crate) fn rows(&self, items: usize) -> Lines {
        self.lines(items, |lines| lines * self.span <= SAMPLES_OF_ROWS)
    }

    /// The same for columns, of which neighbours are taken together as far as their memory and threads go.
    pub(crate) fn columns(&self, items: usize) -> Lines {
        self.lines(items, |lines| lines * self.length <= items * self.most_threads())
    }

    fn most_threads(&self) -> usize {
        (self.limits.threads as usize).min(MOST_THREADS)
    }

    fn lines(&self, items: usize, suits: impl Fn(usize) -> bool) -> Lines {
        let fits = |lines: usize| lines * self.span * SAMPLE_BYTES <= (self.limits.bytes as usize).min(MOST_BYTES);
        let mut lines = MOST_LINES;
        while lines > 1 && !(fits(lines) && suits(lines)) {
            lines /= 2;
        }
        let threads = (lines * self.length).div_ceil(items).next_multiple_of(WAVE);
        Lines { fft: self.clone(), lines, threads: threads.min(self.most_threads()) }
    }
}

/// The radices of a transform of `length`, one for each pass, unless other factors than `all` are left.
fn radices(length: usize, all: &[usize]) -> Option<Vec<usize>> {
    let (mut rest, mut radices) = (length, Vec::new());
    for &radix in all {
        let once = radix == 2;
        while rest.is_multiple_of(radix) && (!once || !rest.trailing_zeros().is_multiple_of(2)) {
            radices.push(radix);
            rest /= radix;
        }
    }
    (rest == 1).then_some(radices)
}

/// A pass of an odd `radix` in WGSL, as those of 3 and 5 in `fft.wgsl`: of samples that lie alike around the first, sums
/// take part by cosines and differences by sines. No thread takes more than `rounds` butterflies.
fn prime_pass(radix: usize, rounds: usize) -> String {
    let half = radix / 2;
    let list = |items: &mut dyn Iterator<Item = String>, between: &str| items.collect::<Vec<_>>().join(between);
    let mut body = String::from("let t1 = turn(place, RADIX, stride, direction);\nlet x0 = line[place];\n");
    for part in 1..radix {
        if part > 1 {
            body += &format!("let t{part} = times(t{}, t{});\n", part / 2, part - part / 2);
        }
        body += &format!("let x{part} = times(line[place + {part}u * COUNT], t{part});\n");
    }
    for part in 1..=half {
        body += &format!("let sum{part} = x{part} + x{0};\nlet less{part} = x{part} - x{0};\n", radix - part);
    }
    for bin in 1..=half {
        let angle = |part: usize| TAU * (bin * part % radix) as f64 / radix as f64;
        let even = list(&mut (1..=half).map(|part| format!("{:?} * sum{part}", angle(part).cos() as f32)), " + ");
        let odd = list(&mut (1..=half).map(|part| format!("{:?} * less{part}", angle(part).sin() as f32)), " + ");
        body += &format!("let even{bin} = x0 + {even};\nlet odd{bin} = quarter_turn({odd}, direction);\n");
    }
    let all = list(&mut (1..=half).map(|part| format!("sum{part}")), " + ");
    let low = list(&mut (1..=half).map(|bin| format!("even{bin} + odd{bin}")), ", ");
    let high = list(&mut (1..=half).rev().map(|bin| format!("even{bin} - odd{bin}")), ", ");
    format!(
        "
fn pass{radix}(stride: u32, direction: f32) {{
    const RADIX = {radix}u;
    const COUNT = SPAN / RADIX * LINES;
    var values: array<array<vec2f, {radix}>, {rounds}>;
    for (var round = 0u; round < {rounds}u; round++) {{
        let place = round * THREADS + thread;
        if (place < COUNT) {{
            {body}values[round] = array(x0 + {all}, {low}, {high});
        }}
    }}
    workgroupBarrier();
    for (var round = 0u; round < {rounds}u; round++) {{
        let place = round * THREADS + thread;
        if (place < COUNT) {{
            let first = output(place, RADIX, stride);
            for (var part = 0u; part < RADIX; part++) {{
                line[first + part * stride * LINES] = values[round][part];
            }}
        }}
    }}
    workgroupBarrier();
}}
"
    )
}

/// exp(-j·π·s²/length) of each sample s.
fn chirps(length: usize) -> impl Iterator<Item = Complex64> {
    (0..length).map(move |sample| {
        let squared = (sample as u64 * sample as u64) % (2 * length as u64);
        Complex64::cis(-PI * squared as f64 / length as f64)
    })
}

/// The spectrum over `span` of the chirps' conjugates, of negative samples too, over `span`.
fn chirp_spectrum(length: usize, span: usize) -> Vec<Complex64> {
    let mut spectrum = vec![Complex64::ZERO; span];
    for (sample, chirp) in chirps(length).enumerate() {
        spectrum[sample] = chirp.conj() / span as f64;
        spectrum[(span - sample) % span] = spectrum[sample];
    }
    f64::plan(span, FftDirection::Forward).process(&mut spectrum);
    spectrum
}

/// Workgroups that transform lines side by side.
pub(crate) struct Lines {
    fft: LineFft,
    /// Lines of one workgroup.
    lines: usize,
    threads: usize,
}

impl Lines {
    /// `fft.wgsl` and `files` with `constants` and those of this transform.
    pub(crate) fn shader(
        &self,
        label: &str,
        constants: &[(&str, Constant)],
        files: &[&str],
        entry: &'static str,
    ) -> Arc<Shader> {
        let Self { fft: LineFft { length, span, radices, .. }, lines, threads } = self;
        // At least one: an array without elements is none.
        let butterflies = |radix: usize| (span / radix * lines).div_ceil(*threads).max(1);
        let rounds = |radix: usize| butterflies(radix).into();
        let own: [(&str, Constant); 9] = [
            ("LENGTH", (*length).into()),
            ("SPAN", (*span).into()),
            ("LINES", (*lines).into()),
            ("THREADS", (*threads).into()),
            ("BLUESTEIN", (span != length).into()),
            ("ROUNDS_2", rounds(2)),
            ("ROUNDS_3", rounds(3)),
            ("ROUNDS_4", rounds(4)),
            ("ROUNDS_5", rounds(5)),
        ];
        let mut source = String::from(include_str!("fft.wgsl"));
        let primes = RADICES[..PRIMES].iter().filter(|radix| radices.contains(radix));
        primes.for_each(|&radix| source.push_str(&prime_pass(radix, butterflies(radix))));
        writeln!(source, "\nfn passes(direction: f32) {{").expect("text grows");
        let mut stride = 1;
        for radix in radices {
            writeln!(source, "    pass{radix}({stride}u, direction);").expect("text grows");
            stride *= radix;
        }
        writeln!(source, "}}").expect("text grows");
        files.iter().for_each(|file| source.push_str(file));
        Arc::new(Shader::new(label, &[&own, constants].concat(), &source, entry))
    }

    /// Binding 0 of such a shader.
    pub(crate) fn turns(&self) -> (u32, BufferId) {
        (0, self.fft.turns)
    }

    /// Workgroups for `count` lines.
    pub(crate) fn workgroups(&self, count: usize) -> usize {
        count.div_ceil(self.lines)
    }
}

#[cfg(test)]
mod tests {
    use super::super::trial::{Trial, complex, largest_difference};
    use super::*;

    const LIMITS: WorkgroupLimits = WorkgroupLimits { bytes: 32 << 10, threads: 1024 };

    /// Transforms rows from binding 1 to binding 2.
    const ROWS: &str = "
        @group(0) @binding(1) var<storage, read> before: array<vec2f>;
        @group(0) @binding(2) var<storage, read_write> after: array<vec2f>;
        @compute @workgroup_size(THREADS)
        fn rows(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) index: u32) {
            thread = index;
            for (var item = 0u; item < ITEMS; item++) {
                let place = item * THREADS + thread;
                let y = group.x * LINES + place % LINES;
                if (place < PLACES && y < HEIGHT) {
                    line[place] = before[y * LENGTH + place / LINES];
                }
            }
            transform(DIRECTION);
            for (var item = 0u; item < ITEMS; item++) {
                let place = item * THREADS + thread;
                let y = group.x * LINES + place % LINES;
                if (place < PLACES && y < HEIGHT) {
                    after[y * LENGTH + place / LINES] = line[place];
                }
            }
        }";

    fn noise(count: usize) -> Vec<Complex64> {
        (0..count).map(|i| Complex64::cis((i as f64 + 0.3).powf(1.7)) * (1.0 + (i % 5) as f64)).collect()
    }

    /// Transforms noise of `height` rows on the device; returns that and the exact transform.
    fn transformed(
        (length, height): (usize, usize),
        lines: impl Fn(&LineFft) -> Lines,
        direction: f32,
    ) -> [Vec<Complex64>; 2] {
        let mut plan = Plan::default();
        let lines = lines(&LineFft::new(&mut plan, length, LIMITS).expect("it fits"));
        let (from, to) =
            (plan.buffer::<[f32; 2]>("from", length * height), plan.buffer::<[f32; 2]>("to", length * height));
        let constants = [("HEIGHT", height.into()), ("DIRECTION", direction.into())];
        let shader = lines.shader("rows", &constants, &[ROWS], "rows");
        let workgroups = [lines.workgroups(height), 1, 1];
        plan.stage("rows", 0).dispatch_with(shader, &[lines.turns(), (1, from), (2, to)], workgroups);
        let trial = Trial::new(&plan);
        let mut values = noise(length * height);
        trial.write(from, &values.iter().flat_map(|value| [value.re as f32, value.im as f32]).collect::<Vec<_>>());
        trial.run();
        let found = complex(&trial.read(to));
        let direction = if direction > 0.0 { FftDirection::Forward } else { FftDirection::Inverse };
        f64::plan(length, direction).process(&mut values);
        [found, values]
    }

    fn error([found, expected]: &[Vec<Complex64>; 2]) -> f64 {
        largest_difference(found, expected)
    }

    #[test]
    fn lines_of_any_length_are_transformed_and_back() {
        let lengths = [
            1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 13, 16, 17, 25, 30, 31, 49, 64, 97, 128, 135, 143, 480, 541, 683, 1001, 1080,
        ]
        .into_iter()
        .chain([1021, 1232, 2080, 3840]);
        for (index, length) in lengths.enumerate() {
            for direction in [1.0, -1.0] {
                let lines = |fft: &LineFft| match index % 3 {
                    0 => fft.rows(4),
                    1 => fft.columns(5),
                    _ => fft.columns(9),
                };
                let mut both = transformed((length, 11), lines, direction);
                let found = error(&both);
                assert!(found < 1e-6, "{length}, direction {direction}: {found}");
                let largest = both[1].iter().map(|value| value.norm()).fold(0.0, f64::max);
                both[1][length * 5].im += 3e-6 * largest;
                assert!(error(&both) > 1e-6, "the comparison is blind");
            }
        }
    }

    #[test]
    fn what_does_not_fit_is_told_with_its_size_and_the_limit() {
        let limits = WorkgroupLimits { bytes: 16 << 10, threads: 128 };
        let new = |length| LineFft::new(&mut Plan::default(), length, limits).map(drop);
        assert_eq!(new(2048), Ok(()));
        assert_eq!(new(1021), Ok(()));
        // Of 2053 samples, a prime, the chirps need 4105 at least, and 4320 has no factor but 2, 3 and 5.
        for (samples, bytes) in [(2160, 17280), (2053, 34560)] {
            let error = new(samples).expect_err("too long");
            assert_eq!(error, GpuError::LineTooLong { samples, bytes, limit: 16384 });
            let text = error.to_string();
            assert!([&samples.to_string(), "16384", "--backend cpu"].iter().all(|part| text.contains(*part)), "{text}");
        }
    }

    /// Half the pixels, across and down, of panels that are sold; with the spans that they take.
    #[test]
    fn lines_of_known_panels_fit_in_the_least_memory_that_devices_have() {
        for (length, span) in [
            (960, 960),
            (540, 540),
            (600, 600),
            (576, 576),
            (636, 1280),
            (512, 512),
            (1200, 1200),
            (2047, 4096),
            (2080, 2080),
            (1232, 1232),
            (1920, 1920),
            (1080, 1080),
        ] {
            assert_eq!(LineFft::new(&mut Plan::default(), length, LIMITS).expect("it fits").span, span, "{length}");
        }
    }

    #[test]
    fn workgroups_keep_within_their_limits() {
        for threads in [128, 256, 1024] {
            let limits = WorkgroupLimits { threads, ..LIMITS };
            for length in 1..=2048 {
                let fft = LineFft::new(&mut Plan::default(), length, limits).expect("it fits");
                for lines in [fft.rows(4), fft.columns(5), fft.columns(9)] {
                    assert!(lines.lines * fft.span * SAMPLE_BYTES <= limits.bytes as usize);
                    assert!(lines.threads <= threads as usize && lines.threads.is_multiple_of(WAVE));
                    assert!(lines.lines.is_power_of_two());
                }
            }
        }
    }
}
