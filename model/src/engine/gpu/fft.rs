//! Circular transforms of lines of samples in a workgroup's memory, for `fft.wgsl`.

use std::collections::BTreeSet;
use std::f64::consts::{PI, TAU};
use std::fmt::Write;
use std::sync::Arc;

use holod_fft::{FftDirection, Real};
use num_complex::{Complex32, Complex64};

use super::plan::{BufferId, Constant, ENABLE_F16, Plan, Shader};
use crate::engine::Precision;
use crate::gpu::GpuError;

/// Prime factors that passes do without chirps.
const PRIMES: [usize; 6] = [2, 3, 5, 7, 11, 13];
/// Those of what chirps are transformed over.
const SMALL_PRIMES: usize = 3;
/// The largest radix: a thread holds a butterfly's samples in registers.
const MOST_RADIX: usize = 16;
/// Bytes of a sample.
const SAMPLE_BYTES: usize = size_of::<Complex32>();
/// Neighbouring columns of this many fill a line of a cache.
const MOST_LINES: usize = 8;
/// More of the memory of workgroups than this for one leaves too few beside it.
const MOST_BYTES: usize = 32 << 10;
/// The same of threads.
const MOST_THREADS: usize = 640;
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
    /// Of the complex numbers in buffers.
    stored: Precision,
    limits: WorkgroupLimits,
}

impl LineFft {
    /// For lines of `length` samples that lie in buffers as `stored`, on a device with these `limits`.
    ///
    /// # Errors
    /// Not even one such line fits in a workgroup.
    pub(crate) fn new(
        plan: &mut Plan,
        length: usize,
        stored: Precision,
        limits: WorkgroupLimits,
    ) -> Result<Self, GpuError> {
        let span = match consists_of(length, &PRIMES) {
            true => length,
            false => {
                (2 * length - 1..).find(|&span| consists_of(span, &PRIMES[..SMALL_PRIMES])).expect("powers of 2 are")
            }
        };
        let radices = radices(span, MOST_RADIX);
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
        Ok(Self { length, span, radices, turns, stored, limits })
    }

    /// The same with radices up to `most`, primes excepted, for threads whose registers hold other things too.
    pub(crate) fn with_radices_up_to(&self, most: usize) -> Self {
        Self { radices: radices(self.span, most), ..self.clone() }
    }

    pub(crate) fn largest_radix(&self) -> usize {
        self.radices.iter().copied().max().unwrap_or(1)
    }

    /// Workgroups for rows, whose threads hold `items` samples, or more where there are not threads enough.
    pub(crate) fn rows(&self, items: usize) -> Lines {
        self.lines(items, |lines| lines * self.span <= SAMPLES_OF_ROWS)
    }

    /// The same for columns, of which neighbours are taken together as far as their memory and threads go.
    pub(crate) fn columns(&self, items: usize) -> Lines {
        self.lines(items, |lines| lines * self.length <= items * self.most_threads())
    }

    /// The same, whose threads hold `pairs` pairs of opposite bins.
    pub(crate) fn mirrored_columns(&self, pairs: usize) -> Lines {
        let lines = self.columns(2 * pairs);
        let threads = (lines.lines * (self.length / 2 + 1)).div_ceil(pairs).next_multiple_of(WAVE);
        Lines { threads: threads.min(self.most_threads()), ..lines }
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

/// Whether all prime factors of `length` are among `primes`.
fn consists_of(length: usize, primes: &[usize]) -> bool {
    let mut rest = length;
    for prime in primes {
        while rest.is_multiple_of(*prime) {
            rest /= prime;
        }
    }
    rest == 1
}

/// The radices of a transform of `length`, which has small prime factors only: as few passes as there can be, the first
/// of an odd radix where it can be, which spreads its stores over the banks of a workgroup's memory, and radices as
/// small as they can be. None is above `most` but primes.
fn radices(length: usize, most: usize) -> Vec<usize> {
    let mut best: Option<Vec<usize>> = None;
    let mut begun = vec![(length, Vec::new())];
    while let Some((rest, radices)) = begun.pop() {
        if rest == 1 {
            let cost = |radices: &Vec<usize>| {
                let even = radices.first().is_some_and(|first| first.is_multiple_of(2));
                (radices.len(), even, radices.iter().sum::<usize>())
            };
            if best.as_ref().is_none_or(|best| cost(&radices) < cost(best)) {
                best = Some(radices);
            }
            continue;
        }
        // What follows the first radix does so in one order.
        let last = if radices.len() < 2 { MOST_RADIX } else { radices[radices.len() - 1] };
        let suits = |radix: &usize| rest.is_multiple_of(*radix) && (*radix <= most || PRIMES.contains(radix));
        for radix in (2..=last).filter(suits) {
            begun.push((rest / radix, [&radices[..], &[radix]].concat()));
        }
    }
    best.expect("a length of small factors")
}

/// Two factors of a radix whose butterfly is made of theirs; `None` where it is written out.
fn split(radix: usize) -> Option<[usize; 2]> {
    let written_out = radix <= 5 || PRIMES.contains(&radix);
    (!written_out).then(|| {
        let factor = [4, 5, 3, 2].into_iter().find(|&factor| radix.is_multiple_of(factor)).expect("a small factor");
        [factor, radix / factor]
    })
}

/// The radices whose butterflies that of `radix` is made of, each after those that it is made of.
fn parts(radix: usize) -> Vec<usize> {
    let below = split(radix).into_iter().flatten().flat_map(parts);
    below.chain([radix]).collect()
}

/// The butterfly of a `radix` that fft.wgsl does not have, in WGSL.
fn butterfly(radix: usize) -> String {
    let list = |items: &mut dyn Iterator<Item = String>, between: &str| items.collect::<Vec<_>>().join(between);
    let (body, outputs) = match split(radix) {
        // Of all samples n·second + m those of each m are transformed, turned, and transformed over m.
        Some([first, second]) => {
            let mut body = String::new();
            for m in 0..second {
                let samples = list(&mut (0..first).map(|n| format!("x[{}]", n * second + m)), ", ");
                body += &format!("    let a{m} = butterfly{first}(array({samples}), direction);\n");
            }
            for k in 0..first {
                let turned = |m: usize| {
                    let turn = Complex64::cis(-TAU * (m * k) as f64 / radix as f64);
                    match m * k {
                        0 => format!("a{m}[{k}]"),
                        _ => {
                            format!("times(a{m}[{k}], vec2f({:?}f, direction * {:?}f))", turn.re as f32, turn.im as f32)
                        }
                    }
                };
                let samples = list(&mut (0..second).map(turned), ", ");
                body += &format!("    let b{k} = butterfly{second}(array({samples}), direction);\n");
            }
            (body, list(&mut (0..radix).map(|bin| format!("b{}[{}]", bin % first, bin / first)), ", "))
        }
        // Of samples that lie alike around the first, sums take part by cosines and differences by sines.
        None => {
            let (half, mut body) = (radix / 2, String::new());
            for part in 1..=half {
                let other = radix - part;
                body += &format!("    let sum{part} = x[{part}] + x[{other}];\n");
                body += &format!("    let less{part} = x[{part}] - x[{other}];\n");
            }
            for bin in 1..=half {
                let angle = |part: usize| TAU * (bin * part % radix) as f64 / radix as f64;
                let even =
                    list(&mut (1..=half).map(|part| format!("{:?} * sum{part}", angle(part).cos() as f32)), " + ");
                let odd =
                    list(&mut (1..=half).map(|part| format!("{:?} * less{part}", angle(part).sin() as f32)), " + ");
                body += &format!(
                    "    let even{bin} = x[0] + {even};\n    let odd{bin} = quarter_turn({odd}, direction);\n"
                );
            }
            let all = list(&mut (1..=half).map(|part| format!("sum{part}")), " + ");
            let low = list(&mut (1..=half).map(|bin| format!("even{bin} + odd{bin}")), ", ");
            let high = list(&mut (1..=half).rev().map(|bin| format!("even{bin} - odd{bin}")), ", ");
            (body, format!("x[0] + {all}, {low}, {high}"))
        }
    };
    format!(
        "
fn butterfly{radix}(x: array<vec2f, {radix}>, direction: f32) -> array<vec2f, {radix}> {{
{body}    return array({outputs});
}}
"
    )
}

/// A pass of `radix` in WGSL, in which no thread takes more than `rounds` butterflies.
fn pass(radix: usize, rounds: usize) -> String {
    let mut load = String::from("let t1 = turn(place, RADIX, stride, direction);\nlet x0 = line[place];\n");
    for part in 1..radix {
        if part > 1 {
            load += &format!("let t{part} = times(t{}, t{});\n", part / 2, part - part / 2);
        }
        load += &format!("let x{part} = times(line[place + {part}u * COUNT], t{part});\n");
    }
    let samples = (0..radix).map(|part| format!("x{part}")).collect::<Vec<_>>().join(", ");
    format!(
        "
fn pass{radix}(stride: u32, direction: f32) {{
    const RADIX = {radix}u;
    const COUNT = SPAN / RADIX * LINES;
    var values: array<array<vec2f, {radix}>, {rounds}>;
    for (var round = 0u; round < {rounds}u; round++) {{
        let place = round * THREADS + thread;
        if (place < COUNT) {{
            {load}values[round] = butterfly{radix}(array({samples}), direction);
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
        let Self { fft: LineFft { length, span, radices, stored, .. }, lines, threads } = self;
        let own: [(&str, Constant); 6] = [
            ("LENGTH", (*length).into()),
            ("SPAN", (*span).into()),
            ("LINES", (*lines).into()),
            ("THREADS", (*threads).into()),
            ("BLUESTEIN", (span != length).into()),
            ("UNITARY", ((*length as f64).powf(-0.5) as f32).into()),
        ];
        // A directive comes before all else.
        let directive = if files.iter().any(|file| file.starts_with(ENABLE_F16)) { ENABLE_F16 } else { "" };
        let mut source = String::from(directive);
        source.push_str(stored.complex());
        source.push_str(include_str!("fft.wgsl"));
        let different: BTreeSet<_> = radices.iter().copied().collect();
        // Those of larger radices are made of those of smaller ones.
        let butterflies: BTreeSet<_> =
            different.iter().flat_map(|&radix| parts(radix)).filter(|&radix| radix > 5).collect();
        butterflies.into_iter().for_each(|radix| source.push_str(&butterfly(radix)));
        different
            .into_iter()
            .for_each(|radix| source.push_str(&pass(radix, (span / radix * lines).div_ceil(*threads))));
        writeln!(source, "\nfn passes(direction: f32) {{").expect("text grows");
        let mut stride = 1;
        for radix in radices {
            writeln!(source, "    pass{radix}({stride}u, direction);").expect("text grows");
            stride *= radix;
        }
        writeln!(source, "}}").expect("text grows");
        files.iter().for_each(|file| source.push_str(file.strip_prefix(ENABLE_F16).unwrap_or(file)));
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

    /// Transforms rows from binding 1 to binding 2, workgroups of y 0 forwards, and those of y 1 back.
    const ROWS: &str = "
        @group(0) @binding(1) var<storage, read> before: array<vec2f>;
        @group(0) @binding(2) var<storage, read_write> after: array<vec2f>;
        @compute @workgroup_size(THREADS)
        fn rows(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) index: u32) {
            thread = index;
            let back = group.y == 1u;
            for (var item = 0u; item < ITEMS; item++) {
                let place = item * THREADS + thread;
                let y = group.x * LINES + place % LINES;
                if (place < PLACES && y < HEIGHT) {
                    line[place] = before[y * LENGTH + place / LINES];
                }
            }
            transform(select(FORWARD, INVERSE, back));
            for (var item = 0u; item < ITEMS; item++) {
                let place = item * THREADS + thread;
                let y = group.x * LINES + place % LINES;
                if (place < PLACES && y < HEIGHT) {
                    after[(group.y * HEIGHT + y) * LENGTH + place / LINES] = line[place];
                }
            }
        }";

    fn noise(count: usize) -> Vec<Complex64> {
        (0..count).map(|i| Complex64::cis((i as f64 + 0.3).powf(1.7)) * (1.0 + (i % 5) as f64)).collect()
    }

    /// Transforms noise of `height` rows on the device, forwards and back; returns each with the exact transform.
    fn transformed((length, height): (usize, usize), lines: impl Fn(&LineFft) -> Lines) -> [[Vec<Complex64>; 2]; 2] {
        let mut plan = Plan::default();
        let lines = lines(&LineFft::new(&mut plan, length, Precision::Single, LIMITS).expect("it fits"));
        let count = length * height;
        let (from, to) = (plan.buffer::<[f32; 2]>("from", count), plan.buffer::<[f32; 2]>("to", 2 * count));
        let shader = lines.shader("rows", &[("HEIGHT", height.into())], &[ROWS], "rows");
        let workgroups = [lines.workgroups(height), 2, 1];
        plan.stage("rows", 0).dispatch_with(shader, &[lines.turns(), (1, from), (2, to)], workgroups);
        let trial = Trial::new(&plan);
        let values = noise(count);
        trial.write(from, &values.iter().flat_map(|value| [value.re as f32, value.im as f32]).collect::<Vec<_>>());
        trial.run();
        let found = complex(Precision::Single, &trial.read(to));
        let (forward, inverse) = found.split_at(count);
        [(forward, FftDirection::Forward), (inverse, FftDirection::Inverse)].map(|(found, direction)| {
            let mut expected = values.clone();
            f64::plan(length, direction).process(&mut expected);
            [found.to_vec(), expected]
        })
    }

    fn error([found, expected]: &[Vec<Complex64>; 2]) -> f64 {
        largest_difference(found, expected)
    }

    #[test]
    fn lines_of_any_length_are_transformed_and_back() {
        let lengths = [
            1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 25, 30, 31, 49, 64, 97, 128, 135, 143, 480, 541,
            683, 1001, 1080,
        ]
        .into_iter()
        .chain([1021, 1232, 2080, 3840]);
        for (index, length) in lengths.enumerate() {
            let lines = |fft: &LineFft| match index % 3 {
                0 => fft.rows(4),
                1 => fft.with_radices_up_to(12).mirrored_columns(2),
                _ => fft.columns(9),
            };
            for (mut both, direction) in transformed((length, 11), lines).into_iter().zip(["forwards", "back"]) {
                let found = error(&both);
                assert!(found < 1e-6, "{length}, {direction}: {found}");
                let largest = both[1].iter().map(|value| value.norm()).fold(0.0, f64::max);
                both[1][length * 5].im += 3e-6 * largest;
                assert!(error(&both) > 1e-6, "the comparison is blind");
            }
        }
    }

    #[test]
    fn what_does_not_fit_is_told_with_its_size_and_the_limit() {
        let limits = WorkgroupLimits { bytes: 16 << 10, threads: 128 };
        let new = |length| LineFft::new(&mut Plan::default(), length, Precision::Single, limits).map(drop);
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
            assert_eq!(
                LineFft::new(&mut Plan::default(), length, Precision::Single, LIMITS).expect("it fits").span,
                span,
                "{length}"
            );
        }
    }

    #[test]
    fn passes_are_few_and_the_first_radix_is_odd_where_it_can_be() {
        let known: [(usize, &[usize]); 5] =
            [(1, &[]), (8, &[8]), (540, &[9, 10, 6]), (960, &[15, 8, 8]), (2080, &[13, 16, 10])];
        for (length, expected) in known {
            assert_eq!(radices(length, MOST_RADIX), expected, "{length}");
        }
        assert_eq!(radices(540, 12), [9, 10, 6]);
        assert_eq!(radices(256, 12).iter().max(), Some(&8));
        assert_eq!(radices(13 * 16, 12).iter().max(), Some(&13), "a prime has no smaller ones");
    }

    #[test]
    fn workgroups_keep_within_their_limits() {
        for threads in [128, 256, 1024] {
            let limits = WorkgroupLimits { threads, ..LIMITS };
            for length in 1..=2048 {
                let fft = LineFft::new(&mut Plan::default(), length, Precision::Single, limits).expect("it fits");
                let blurred = fft.with_radices_up_to(12).mirrored_columns(2);
                for lines in [fft.rows(4), fft.columns(5), fft.columns(9), blurred] {
                    assert!(lines.lines * fft.span * SAMPLE_BYTES <= limits.bytes as usize);
                    assert!(lines.threads <= threads as usize && lines.threads.is_multiple_of(WAVE));
                    assert!(lines.lines.is_power_of_two());
                }
            }
        }
    }
}
