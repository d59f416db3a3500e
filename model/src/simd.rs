//! Vectors of `f32` for whichever instruction set the processor has, chosen at run time.
//!
//! A value of an instruction set's type exists only where the processor has that set, which is what makes calling its
//! instructions sound.

#[cfg(target_arch = "x86_64")]
use std::mem;

/// The lanes of the widest vector.
pub(crate) const MOST_LANES: usize = 16;

/// One instruction set. Everything here is inlined into [`Simd::vectorise`], where the set's features are enabled.
pub(crate) trait Simd: Copy + Send + Sync {
    /// A vector of `LANES` values.
    type Vector: Copy;
    const LANES: usize;

    fn splat(self, value: f32) -> Self::Vector;
    /// Two values, in turn in all lanes.
    ///
    /// # Safety
    /// `from` points to two readable values.
    unsafe fn splat_pair(self, from: *const f32) -> Self::Vector;
    /// # Safety
    /// `from` points to `LANES` readable values.
    unsafe fn load(self, from: *const f32) -> Self::Vector;
    /// N vectors whose first values lie `stride` values apart.
    ///
    /// No closure, as `array::from_fn` would want: the compiler would make a function without the set's features of it.
    ///
    /// # Safety
    /// From each of these places `LANES` values are readable.
    #[inline(always)]
    unsafe fn load_strided<const N: usize>(self, from: *const f32, stride: usize) -> [Self::Vector; N] {
        let mut vectors = [self.splat(0.0); N];
        for (index, vector) in vectors.iter_mut().enumerate() {
            // SAFETY: the caller's.
            *vector = unsafe { self.load(from.add(index * stride)) };
        }
        vectors
    }
    /// # Safety
    /// `to` points to `LANES` writable values.
    unsafe fn store(self, to: *mut f32, vector: Self::Vector);
    /// The first `LANES` values.
    #[inline(always)]
    fn read(self, from: &[f32]) -> Self::Vector {
        assert!(from.len() >= Self::LANES);
        // SAFETY: this many are readable.
        unsafe { self.load(from.as_ptr()) }
    }
    /// Writes the first `LANES` values.
    #[inline(always)]
    fn write(self, to: &mut [f32], vector: Self::Vector) {
        assert!(to.len() >= Self::LANES);
        // SAFETY: this many are writable.
        unsafe { self.store(to.as_mut_ptr(), vector) }
    }
    /// a·b + c of each lane.
    fn mul_add(self, a: Self::Vector, b: Self::Vector, c: Self::Vector) -> Self::Vector;
    /// c − a·b of each lane.
    fn neg_mul_add(self, a: Self::Vector, b: Self::Vector, c: Self::Vector) -> Self::Vector;
    fn add(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    fn sub(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    fn mul(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    fn div(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    fn sqrt(self, a: Self::Vector) -> Self::Vector;
    /// The larger one, and `b` where either is no number.
    fn max(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    /// The larger one of `a`, which is a magnitude, and the magnitude of `b`; what is no number is larger than all others.
    fn larger_magnitude(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    /// `value` where `a` and `b` are equal, else 0.
    fn where_equal(self, a: Self::Vector, b: Self::Vector, value: Self::Vector) -> Self::Vector;
    /// Lanes 0, 2, 4 and so on of `a`, then those of `b`; and the lanes between them.
    fn unzip(self, a: Self::Vector, b: Self::Vector) -> [Self::Vector; 2];
    /// The sums of lanes 0 and 1, 2 and 3 and so on of `a`, then those of `b`.
    #[inline(always)]
    fn add_pairs(self, a: Self::Vector, b: Self::Vector) -> Self::Vector {
        let [even, odd] = self.unzip(a, b);
        self.add(even, odd)
    }
    /// Factors in a word, the 32 bits of a lane: one `f32`, or two of neighbouring channels, first channel in the lower
    /// half, as bfloat16s or as integers of 16 bits.
    const FACTORS: usize = 1;
    /// Whether factors are integers: what is written as such was scaled to whole numbers of 16 bits, and sums of their
    /// products are integers of 32 bits, which do not overflow where they stay below 2³¹.
    const INTEGERS: bool = false;
    /// Writes `LANES` values as factors, in `LANES / FACTORS` words.
    ///
    /// # Safety
    /// `to` points to as many writable words.
    #[inline(always)]
    unsafe fn store_factors(self, to: *mut f32, vector: Self::Vector) {
        // SAFETY: the caller's.
        unsafe { self.store(to, vector) }
    }
    /// The sum of a word's products and c: a·b + c, or a₀·b₀ + a₁·b₁ + c.
    #[inline(always)]
    fn mul_add_factors(self, a: Self::Vector, b: Self::Vector, c: Self::Vector) -> Self::Vector {
        self.mul_add(a, b, c)
    }
    /// Sums of words' products as values.
    #[inline(always)]
    fn values_of_sums(self, sums: Self::Vector) -> Self::Vector {
        sums
    }
    /// Writes the transpose of a square of `LANES` by `LANES` values, whose rows begin `pitches[0]` values apart, to a
    /// square whose rows begin `pitches[1]` apart.
    ///
    /// # Safety
    /// All of the first square is readable, and all of the second, which lies elsewhere, writable.
    unsafe fn transpose(self, from: *const f32, to: *mut f32, pitches: [usize; 2]);

    /// Runs `task` with this set's instructions enabled.
    fn vectorise<T: Task>(self, task: T);
}

/// Work that is compiled once for each instruction set: with its vectors, or in plain Rust of which the compiler makes
/// vectors. `run` must be `#[inline(always)]`.
pub(crate) trait Task {
    fn run<S: Simd>(self, simd: S);
}

/// An instruction set that this processor has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum InstructionSet {
    #[cfg(target_arch = "x86_64")]
    Avx512(Avx512),
    #[cfg(target_arch = "x86_64")]
    Avx2(Avx2),
    Portable(Portable<4>),
    /// Sixteen lanes in plain Rust: the blocking of AVX-512 on machines without it.
    #[cfg(test)]
    Wide(Portable<16>),
}

impl InstructionSet {
    /// Every set that this processor has, best first; never empty.
    pub(crate) fn available() -> impl Iterator<Item = Self> {
        #[cfg(target_arch = "x86_64")]
        let special = [Avx512::detect().map(Self::Avx512), Avx2::detect().map(Self::Avx2)];
        #[cfg(not(target_arch = "x86_64"))]
        let special: [Option<Self>; 0] = [];
        special.into_iter().flatten().chain([
            Self::Portable(Portable),
            #[cfg(test)]
            Self::Wide(Portable),
        ])
    }

    pub(crate) fn best() -> Self {
        Self::available().next().unwrap_or(Self::Portable(Portable))
    }

    pub(crate) fn name(self) -> &'static str {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512(_) => "avx512",
            #[cfg(target_arch = "x86_64")]
            Self::Avx2(_) => "avx2",
            Self::Portable(_) => "portable",
            #[cfg(test)]
            Self::Wide(_) => "wide",
        }
    }

    pub(crate) fn lanes(self) -> usize {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512(_) => Avx512::LANES,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2(_) => Avx2::LANES,
            Self::Portable(_) => Portable::<4>::LANES,
            #[cfg(test)]
            Self::Wide(_) => Portable::<16>::LANES,
        }
    }

    pub(crate) fn run(self, task: impl Task) {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512(simd) => simd.vectorise(task),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2(simd) => simd.vectorise(task),
            Self::Portable(simd) => simd.vectorise(task),
            #[cfg(test)]
            Self::Wide(simd) => simd.vectorise(task),
        }
    }
}

/// What layers multiply with: the vectors of an instruction set, and factors in single precision, as bfloat16s, or as
/// integers of 16 bits that have a scale in common. Sums have 32 bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Products {
    Single(InstructionSet),
    #[cfg(target_arch = "x86_64")]
    Avx512Bf16(Avx512Bf16),
    #[cfg(target_arch = "x86_64")]
    Avx2Integers(Avx2Integers),
    #[cfg(test)]
    PortableHalf(Portable<4, 2>),
    #[cfg(test)]
    WideHalf(Portable<16, 2>),
    #[cfg(test)]
    PortableIntegers(Portable<4, 2, true>),
    #[cfg(test)]
    WideIntegers(Portable<16, 2, true>),
}

impl Products {
    /// All that this processor can do.
    #[cfg(test)]
    pub(crate) fn available() -> impl Iterator<Item = Self> {
        let mut half = vec![
            Self::PortableHalf(Portable),
            Self::WideHalf(Portable),
            Self::PortableIntegers(Portable),
            Self::WideIntegers(Portable),
        ];
        #[cfg(target_arch = "x86_64")]
        half.extend(Avx512Bf16::detect().map(Self::Avx512Bf16));
        #[cfg(target_arch = "x86_64")]
        half.extend(Avx2Integers::detect().map(Self::Avx2Integers));
        InstructionSet::available().map(Self::Single).chain(half)
    }

    /// Products in half precision, where the processor has an instruction for them that works on vectors as wide as its
    /// widest: of bfloat16s with AVX-512, where it has them, and of integers with AVX2.
    pub(crate) fn half() -> Option<Self> {
        match InstructionSet::best() {
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx512(_) => Avx512Bf16::detect().map(Self::Avx512Bf16),
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx2(_) => Avx2Integers::detect().map(Self::Avx2Integers),
            _ => None,
        }
    }

    /// The instruction set of its vectors.
    pub(crate) fn set(self) -> InstructionSet {
        match self {
            Self::Single(set) => set,
            #[cfg(target_arch = "x86_64")]
            Self::Avx512Bf16(simd) => InstructionSet::Avx512(simd.into()),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2Integers(simd) => InstructionSet::Avx2(simd.into()),
            #[cfg(test)]
            Self::PortableHalf(_) | Self::PortableIntegers(_) => InstructionSet::Portable(Portable),
            #[cfg(test)]
            Self::WideHalf(_) | Self::WideIntegers(_) => InstructionSet::Wide(Portable),
        }
    }

    /// Factors in a word, as [`Simd::FACTORS`].
    pub(crate) fn factors(self) -> usize {
        if matches!(self, Self::Single(_)) { 1 } else { 2 }
    }

    /// Whether factors are integers, as [`Simd::INTEGERS`].
    pub(crate) fn integers(self) -> bool {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx2Integers(_) => true,
            #[cfg(test)]
            Self::PortableIntegers(_) | Self::WideIntegers(_) => true,
            _ => false,
        }
    }

    /// Makes `value` a word's factor, and leaves the word's other one as it is.
    pub(crate) fn set_factor(self, word: &mut f32, factor: usize, value: f32) {
        *word = if self.factors() == 1 {
            value
        } else {
            let mut halves = halves_of(*word);
            halves[factor] = if self.integers() { integer(value) } else { half::bf16::from_f32(value).to_bits() };
            word_of(halves)
        };
    }

    /// The factors in a word, first channel first.
    #[cfg(test)]
    pub(crate) fn factors_of(self, word: f32) -> Vec<f32> {
        let value = |half: u16| {
            if self.integers() { f32::from(half.cast_signed()) } else { half::bf16::from_bits(half).to_f32() }
        };
        if self.factors() == 1 { vec![word] } else { halves_of(word).map(value).to_vec() }
    }

    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Single(set) => set.name(),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512Bf16(_) => "avx512 in half precision",
            #[cfg(target_arch = "x86_64")]
            Self::Avx2Integers(_) => "avx2 in half precision",
            #[cfg(test)]
            Self::PortableHalf(_) => "portable in half precision",
            #[cfg(test)]
            Self::WideHalf(_) => "wide in half precision",
            #[cfg(test)]
            Self::PortableIntegers(_) => "portable in integers",
            #[cfg(test)]
            Self::WideIntegers(_) => "wide in integers",
        }
    }

    pub(crate) fn run(self, task: impl Task) {
        match self {
            Self::Single(set) => set.run(task),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512Bf16(simd) => simd.vectorise(task),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2Integers(simd) => simd.vectorise(task),
            #[cfg(test)]
            Self::PortableHalf(simd) => simd.vectorise(task),
            #[cfg(test)]
            Self::WideHalf(simd) => simd.vectorise(task),
            #[cfg(test)]
            Self::PortableIntegers(simd) => simd.vectorise(task),
            #[cfg(test)]
            Self::WideIntegers(simd) => simd.vectorise(task),
        }
    }
}

/// `N` lanes in plain Rust, with `FACTORS` factors in a word; four are what every compiler target has base vectors for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Portable<const N: usize, const FACTORS: usize = 1, const INTEGERS: bool = false>;

impl<const N: usize, const FACTORS: usize, const INTEGERS: bool> Simd for Portable<N, FACTORS, INTEGERS> {
    type Vector = [f32; N];
    const LANES: usize = N;
    const FACTORS: usize = FACTORS;
    const INTEGERS: bool = INTEGERS;

    #[inline(always)]
    unsafe fn store_factors(self, to: *mut f32, vector: [f32; N]) {
        let half = |value| if INTEGERS { integer(value) } else { half::bf16::from_f32(value).to_bits() };
        for (word, values) in vector.chunks(FACTORS).enumerate() {
            // SAFETY: the caller promises as many writable words as there are chunks.
            unsafe {
                *to.add(word) = match *values {
                    [first, second] => word_of([first, second].map(half)),
                    [value, ..] => value,
                    [] => unreachable!("chunks are not empty"),
                };
            }
        }
    }

    #[inline(always)]
    fn mul_add_factors(self, a: [f32; N], b: [f32; N], c: [f32; N]) -> [f32; N] {
        if FACTORS == 1 {
            return self.mul_add(a, b, c);
        }
        std::array::from_fn(|lane| {
            let (a, b) = (halves_of(a[lane]), halves_of(b[lane]));
            if INTEGERS {
                let [[a0, a1], [b0, b1]] = [a, b].map(|word| word.map(|half| i32::from(half.cast_signed())));
                let products = (a0 * b0).wrapping_add(a1 * b1);
                f32::from_bits(c[lane].to_bits().cast_signed().wrapping_add(products).cast_unsigned())
            } else {
                let [[a0, a1], [b0, b1]] = [a, b].map(|word| word.map(|half| half::bf16::from_bits(half).to_f32()));
                a0 * b0 + a1 * b1 + c[lane]
            }
        })
    }

    #[inline(always)]
    fn values_of_sums(self, sums: [f32; N]) -> [f32; N] {
        if INTEGERS { sums.map(|sum| sum.to_bits().cast_signed() as f32) } else { sums }
    }

    #[inline(always)]
    fn splat(self, value: f32) -> [f32; N] {
        [value; N]
    }

    #[inline(always)]
    unsafe fn splat_pair(self, from: *const f32) -> [f32; N] {
        // SAFETY: the caller promises two readable values.
        let pair = unsafe { [*from, *from.add(1)] };
        std::array::from_fn(|lane| pair[lane % 2])
    }

    #[inline(always)]
    unsafe fn load(self, from: *const f32) -> [f32; N] {
        // SAFETY: the caller promises N readable values; f32 arrays have f32's alignment.
        unsafe { *from.cast() }
    }

    #[inline(always)]
    unsafe fn store(self, to: *mut f32, vector: [f32; N]) {
        // SAFETY: the caller promises N writable values; f32 arrays have f32's alignment.
        unsafe { *to.cast() = vector }
    }

    #[inline(always)]
    fn mul_add(self, a: [f32; N], b: [f32; N], c: [f32; N]) -> [f32; N] {
        // Where the target has no fused instruction, `mul_add` would be a slow library call.
        std::array::from_fn(|lane| {
            if cfg!(any(target_arch = "aarch64", target_feature = "fma")) {
                a[lane].mul_add(b[lane], c[lane])
            } else {
                a[lane] * b[lane] + c[lane]
            }
        })
    }

    #[inline(always)]
    fn neg_mul_add(self, a: [f32; N], b: [f32; N], c: [f32; N]) -> [f32; N] {
        self.mul_add(a.map(|value| -value), b, c)
    }

    #[inline(always)]
    fn add(self, a: [f32; N], b: [f32; N]) -> [f32; N] {
        std::array::from_fn(|lane| a[lane] + b[lane])
    }

    #[inline(always)]
    fn sub(self, a: [f32; N], b: [f32; N]) -> [f32; N] {
        std::array::from_fn(|lane| a[lane] - b[lane])
    }

    #[inline(always)]
    fn mul(self, a: [f32; N], b: [f32; N]) -> [f32; N] {
        std::array::from_fn(|lane| a[lane] * b[lane])
    }

    #[inline(always)]
    fn div(self, a: [f32; N], b: [f32; N]) -> [f32; N] {
        std::array::from_fn(|lane| a[lane] / b[lane])
    }

    #[inline(always)]
    fn sqrt(self, a: [f32; N]) -> [f32; N] {
        a.map(f32::sqrt)
    }

    #[inline(always)]
    fn larger_magnitude(self, a: [f32; N], b: [f32; N]) -> [f32; N] {
        std::array::from_fn(|lane| f32::from_bits(a[lane].to_bits().max(b[lane].abs().to_bits())))
    }

    #[inline(always)]
    fn where_equal(self, a: [f32; N], b: [f32; N], value: [f32; N]) -> [f32; N] {
        std::array::from_fn(|lane| if a[lane] == b[lane] { value[lane] } else { 0.0 })
    }

    #[inline(always)]
    fn max(self, a: [f32; N], b: [f32; N]) -> [f32; N] {
        std::array::from_fn(|lane| if a[lane] > b[lane] { a[lane] } else { b[lane] })
    }

    #[inline(always)]
    fn unzip(self, a: [f32; N], b: [f32; N]) -> [[f32; N]; 2] {
        let of = |odd: usize| {
            std::array::from_fn(|lane| if lane < N / 2 { a[2 * lane + odd] } else { b[2 * lane - N + odd] })
        };
        [of(0), of(1)]
    }

    #[inline(always)]
    unsafe fn transpose(self, from: *const f32, to: *mut f32, [from_pitch, to_pitch]: [usize; 2]) {
        for (row, column) in (0..N).flat_map(|row| (0..N).map(move |column| (row, column))) {
            // SAFETY: the caller promises N readable rows and N writable ones.
            unsafe { *to.add(column * to_pitch + row) = *from.add(row * from_pitch + column) };
        }
    }

    fn vectorise<T: Task>(self, task: T) {
        task.run(self);
    }
}

/// A word of two halves, the first one in its lower bits.
fn word_of([low, high]: [u16; 2]) -> f32 {
    f32::from_bits(u32::from(high) << 16 | u32::from(low))
}

fn halves_of(word: f32) -> [u16; 2] {
    [word.to_bits() as u16, (word.to_bits() >> 16) as u16]
}

/// The bits of the nearest whole number that 16 bits hold.
fn integer(value: f32) -> u16 {
    (value.round_ties_even() as i16).cast_unsigned()
}

#[cfg(target_arch = "x86_64")]
macro_rules! x86_instruction_set {
    (
        $(#[$doc:meta])* $name:ident, $lanes:literal, $vector:ident, $features:literal, detect $($feature:tt),+;
        $set1:ident, $loadu:ident, $storeu:ident, $fmadd:ident, $fnmadd:ident, $add:ident, $sub:ident, $mul:ident,
        $div:ident, $sqrt:ident, $max:ident;
        larger_magnitude($m:ident, $n:ident) $larger_magnitude:expr;
        where_equal($x:ident, $y:ident, $value:ident) $where_equal:expr;
        $set1_pair:ident, $cast_pair:ident; unzip($a:ident, $b:ident) $unzip:expr;
        transpose($rows:ident) $transpose:expr
        $(; factors $factors:literal $(, integers $integers:literal values_of_sums($sums:ident) $values_of_sums:expr;)?
        store_factors($to:ident, $from:ident) $store_factors:expr;
        mul_add_factors($p:ident, $q:ident, $sum:ident) $mul_add_factors:expr)?
    ) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub(crate) struct $name(());

        impl $name {
            fn detect() -> Option<Self> {
                ($(std::arch::is_x86_feature_detected!($feature))&&+).then_some(Self(()))
            }
        }

        // SAFETY, for every block below: a value of this type exists only where `detect` found the features, so the
        // instructions are there; `splat_pair`, `load`, `store` and `store_factors` pass their callers' promises on.
        #[allow(clippy::undocumented_unsafe_blocks, reason = "one reason for all, above")]
        impl Simd for $name {
            type Vector = std::arch::x86_64::$vector;
            const LANES: usize = $lanes;

            #[inline(always)]
            fn splat(self, value: f32) -> Self::Vector {
                unsafe { std::arch::x86_64::$set1(value) }
            }

            #[inline(always)]
            unsafe fn splat_pair(self, from: *const f32) -> Self::Vector {
                unsafe {
                    let pair = from.cast::<f64>().read_unaligned();
                    std::arch::x86_64::$cast_pair(std::arch::x86_64::$set1_pair(pair))
                }
            }

            #[inline(always)]
            unsafe fn load(self, from: *const f32) -> Self::Vector {
                unsafe { std::arch::x86_64::$loadu(from) }
            }

            #[inline(always)]
            unsafe fn store(self, to: *mut f32, vector: Self::Vector) {
                unsafe { std::arch::x86_64::$storeu(to, vector) }
            }

            #[inline(always)]
            fn mul_add(self, a: Self::Vector, b: Self::Vector, c: Self::Vector) -> Self::Vector {
                unsafe { std::arch::x86_64::$fmadd(a, b, c) }
            }

            #[inline(always)]
            fn neg_mul_add(self, a: Self::Vector, b: Self::Vector, c: Self::Vector) -> Self::Vector {
                unsafe { std::arch::x86_64::$fnmadd(a, b, c) }
            }

            #[inline(always)]
            fn add(self, a: Self::Vector, b: Self::Vector) -> Self::Vector {
                unsafe { std::arch::x86_64::$add(a, b) }
            }

            #[inline(always)]
            fn sub(self, a: Self::Vector, b: Self::Vector) -> Self::Vector {
                unsafe { std::arch::x86_64::$sub(a, b) }
            }

            #[inline(always)]
            fn mul(self, a: Self::Vector, b: Self::Vector) -> Self::Vector {
                unsafe { std::arch::x86_64::$mul(a, b) }
            }

            #[inline(always)]
            fn div(self, a: Self::Vector, b: Self::Vector) -> Self::Vector {
                unsafe { std::arch::x86_64::$div(a, b) }
            }

            #[inline(always)]
            fn sqrt(self, a: Self::Vector) -> Self::Vector {
                unsafe { std::arch::x86_64::$sqrt(a) }
            }

            #[inline(always)]
            fn larger_magnitude(self, $m: Self::Vector, $n: Self::Vector) -> Self::Vector {
                use std::arch::x86_64::*;
                unsafe { $larger_magnitude }
            }

            #[inline(always)]
            fn where_equal(self, $x: Self::Vector, $y: Self::Vector, $value: Self::Vector) -> Self::Vector {
                use std::arch::x86_64::*;
                unsafe { $where_equal }
            }

            #[inline(always)]
            fn max(self, a: Self::Vector, b: Self::Vector) -> Self::Vector {
                unsafe { std::arch::x86_64::$max(a, b) }
            }

            #[inline(always)]
            fn unzip(self, $a: Self::Vector, $b: Self::Vector) -> [Self::Vector; 2] {
                use std::arch::x86_64::*;
                unsafe { $unzip }
            }

            #[inline(always)]
            unsafe fn transpose(self, from: *const f32, to: *mut f32, [from_pitch, to_pitch]: [usize; 2]) {
                use std::arch::x86_64::*;
                unsafe {
                    let $rows: [Self::Vector; $lanes] = self.load_strided(from, from_pitch);
                    for (row, vector) in $transpose.into_iter().enumerate() {
                        self.store(to.add(row * to_pitch), vector);
                    }
                }
            }

            $(const FACTORS: usize = $factors;

            $(const INTEGERS: bool = $integers;

            #[inline(always)]
            fn values_of_sums(self, $sums: Self::Vector) -> Self::Vector {
                use std::arch::x86_64::*;
                unsafe { $values_of_sums }
            })?

            #[inline(always)]
            unsafe fn store_factors(self, $to: *mut f32, $from: Self::Vector) {
                use std::arch::x86_64::*;
                unsafe { $store_factors }
            }

            #[inline(always)]
            fn mul_add_factors(self, $p: Self::Vector, $q: Self::Vector, $sum: Self::Vector) -> Self::Vector {
                use std::arch::x86_64::*;
                unsafe { $mul_add_factors }
            })?

            fn vectorise<T: Task>(self, task: T) {
                #[target_feature(enable = $features)]
                fn with_features<T: Task>(simd: $name, task: T) {
                    task.run(simd);
                }
                unsafe { with_features(self, task) }
            }
        }
    };
}

/// Two instruction sets of the same vectors.
#[cfg(target_arch = "x86_64")]
macro_rules! avx2 {
    ($(#[$doc:meta])* $name:ident; $($factors:tt)*) => {
        x86_instruction_set! {
            $(#[$doc])*
            $name, 8, __m256, "avx2,fma", detect "avx2", "fma";
            _mm256_set1_ps, _mm256_loadu_ps, _mm256_storeu_ps, _mm256_fmadd_ps, _mm256_fnmadd_ps, _mm256_add_ps,
            _mm256_sub_ps, _mm256_mul_ps, _mm256_div_ps, _mm256_sqrt_ps, _mm256_max_ps;
            larger_magnitude(a, b) {
                let magnitude = _mm256_andnot_si256(_mm256_set1_epi32(i32::MIN), _mm256_castps_si256(b));
                _mm256_castsi256_ps(_mm256_max_epi32(_mm256_castps_si256(a), magnitude))
            };
            where_equal(a, b, value) _mm256_and_ps(_mm256_cmp_ps::<_CMP_EQ_OQ>(a, b), value);
            _mm256_set1_pd, _mm256_castpd_ps;
            unzip(a, b) {
                // Lanes of both, by turns of two: the middle two are exchanged.
                let mut both = [_mm256_shuffle_ps::<0b10_00_10_00>(a, b), _mm256_shuffle_ps::<0b11_01_11_01>(a, b)];
                for lanes in &mut both {
                    *lanes = _mm256_castpd_ps(_mm256_permute4x64_pd::<0b11_01_10_00>(_mm256_castps_pd(*lanes)));
                }
                both
            };
            transpose(rows) {
                let mut to = rows;
                let mut fours = rows;
                for four in [0, 4] {
                    let [a, b, c, d] = [rows[four], rows[four + 1], rows[four + 2], rows[four + 3]];
                    let (ab, cd) = (_mm256_unpacklo_ps(a, b), _mm256_unpacklo_ps(c, d));
                    let (ab, cd) = (_mm256_castps_pd(ab), _mm256_castps_pd(cd));
                    fours[four] = _mm256_castpd_ps(_mm256_unpacklo_pd(ab, cd));
                    fours[four + 1] = _mm256_castpd_ps(_mm256_unpackhi_pd(ab, cd));
                    let (ab, cd) = (_mm256_unpackhi_ps(a, b), _mm256_unpackhi_ps(c, d));
                    let (ab, cd) = (_mm256_castps_pd(ab), _mm256_castps_pd(cd));
                    fours[four + 2] = _mm256_castpd_ps(_mm256_unpacklo_pd(ab, cd));
                    fours[four + 3] = _mm256_castpd_ps(_mm256_unpackhi_pd(ab, cd));
                }
                for column in 0..4 {
                    to[column] = _mm256_permute2f128_ps::<0x20>(fours[column], fours[column + 4]);
                    to[column + 4] = _mm256_permute2f128_ps::<0x31>(fours[column], fours[column + 4]);
                }
                to
            }
            $($factors)*
        }
    };
}

#[cfg(target_arch = "x86_64")]
avx2! {
    /// AVX2 with fused multiply-add: 16 registers of 8 lanes.
    Avx2;
}

#[cfg(target_arch = "x86_64")]
avx2! {
    /// The same with sums of two products of integers of 16 bits in each lane.
    Avx2Integers;
    ; factors 2, integers true
    values_of_sums(sums) _mm256_cvtepi32_ps(_mm256_castps_si256(sums));
    store_factors(to, from) {
        let whole = _mm256_cvtps_epi32(from);
        let (low, high) = (_mm256_castsi256_si128(whole), _mm256_extracti128_si256::<1>(whole));
        _mm_storeu_si128(to.cast(), _mm_packs_epi32(low, high));
    };
    mul_add_factors(a, b, c) {
        let products = _mm256_madd_epi16(_mm256_castps_si256(a), _mm256_castps_si256(b));
        _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(c), products))
    }
}

#[cfg(target_arch = "x86_64")]
impl From<Avx2Integers> for Avx2 {
    fn from(_: Avx2Integers) -> Self {
        Self(())
    }
}

/// Two instruction sets of the same vectors.
#[cfg(target_arch = "x86_64")]
macro_rules! avx512 {
    (
        $(#[$doc:meta])* $name:ident, $features:literal, detect $($feature:tt),+;
        $($factors:tt)*
    ) => {
        x86_instruction_set! {
            $(#[$doc])*
            $name, 16, __m512, $features, detect $($feature),+;
            _mm512_set1_ps, _mm512_loadu_ps, _mm512_storeu_ps, _mm512_fmadd_ps, _mm512_fnmadd_ps, _mm512_add_ps,
            _mm512_sub_ps, _mm512_mul_ps, _mm512_div_ps, _mm512_sqrt_ps, _mm512_max_ps;
            larger_magnitude(a, b) {
                let magnitude = _mm512_andnot_epi32(_mm512_set1_epi32(i32::MIN), _mm512_castps_si512(b));
                _mm512_castsi512_ps(_mm512_max_epi32(_mm512_castps_si512(a), magnitude))
            };
            where_equal(a, b, value) _mm512_maskz_mov_ps(_mm512_cmp_ps_mask::<_CMP_EQ_OQ>(a, b), value);
            _mm512_set1_pd, _mm512_castpd_ps;
            unzip(a, b) {
                // Lanes from 16 on are those of `b`.
                let even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
                let odd = _mm512_setr_epi32(1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
                [_mm512_permutex2var_ps(a, even, b), _mm512_permutex2var_ps(a, odd, b)]
            };
            transpose(rows) {
                let mut to = rows;
                let mut fours = rows;
                for four in [0, 4, 8, 12] {
                    let [a, b, c, d] = [rows[four], rows[four + 1], rows[four + 2], rows[four + 3]];
                    let (ab, cd) = (_mm512_unpacklo_ps(a, b), _mm512_unpacklo_ps(c, d));
                    let (ab, cd) = (_mm512_castps_pd(ab), _mm512_castps_pd(cd));
                    fours[four] = _mm512_castpd_ps(_mm512_unpacklo_pd(ab, cd));
                    fours[four + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(ab, cd));
                    let (ab, cd) = (_mm512_unpackhi_ps(a, b), _mm512_unpackhi_ps(c, d));
                    let (ab, cd) = (_mm512_castps_pd(ab), _mm512_castps_pd(cd));
                    fours[four + 2] = _mm512_castpd_ps(_mm512_unpacklo_pd(ab, cd));
                    fours[four + 3] = _mm512_castpd_ps(_mm512_unpackhi_pd(ab, cd));
                }
                for column in 0..4 {
                    let [a, b, c, d] = [fours[column], fours[column + 4], fours[column + 8], fours[column + 12]];
                    let (ab_low, ab_high) = (_mm512_shuffle_f32x4::<0x44>(a, b), _mm512_shuffle_f32x4::<0xee>(a, b));
                    let (cd_low, cd_high) = (_mm512_shuffle_f32x4::<0x44>(c, d), _mm512_shuffle_f32x4::<0xee>(c, d));
                    to[column] = _mm512_shuffle_f32x4::<0x88>(ab_low, cd_low);
                    to[column + 4] = _mm512_shuffle_f32x4::<0xdd>(ab_low, cd_low);
                    to[column + 8] = _mm512_shuffle_f32x4::<0x88>(ab_high, cd_high);
                    to[column + 12] = _mm512_shuffle_f32x4::<0xdd>(ab_high, cd_high);
                }
                to
            }
            $($factors)*
        }
    };
}

#[cfg(target_arch = "x86_64")]
avx512! {
    /// AVX-512: 32 registers of 16 lanes.
    Avx512, "avx512f", detect "avx512f";
}

#[cfg(target_arch = "x86_64")]
avx512! {
    /// The same with sums of two products of bfloat16s in each lane.
    Avx512Bf16, "avx512f,avx512bf16", detect "avx512f", "avx512bf16";
    ; factors 2
    store_factors(to, from) _mm256_storeu_si256(to.cast(), mem::transmute::<__m256bh, __m256i>(_mm512_cvtneps_pbh(from)));
    mul_add_factors(a, b, c) {
        _mm512_dpbf16_ps(c, mem::transmute::<__m512, __m512bh>(a), mem::transmute::<__m512, __m512bh>(b))
    }
}

#[cfg(target_arch = "x86_64")]
impl From<Avx512Bf16> for Avx512 {
    fn from(_: Avx512Bf16) -> Self {
        Self(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Writes a vector that `splat_pair` gives, and one that `add_pairs` gives.
    struct Pairs<'a>(&'a mut Vec<f32>);

    impl Task for Pairs<'_> {
        #[inline(always)]
        fn run<S: Simd>(self, simd: S) {
            let values: Vec<f32> = (0..2 * S::LANES).map(|value| (value * value) as f32).collect();
            self.0.resize(2 * S::LANES, 0.0);
            // SAFETY: `values` and the output hold two vectors.
            unsafe {
                let (first, second) = (simd.load(values.as_ptr()), simd.load(values.as_ptr().add(S::LANES)));
                simd.store(self.0.as_mut_ptr(), simd.splat_pair(values.as_ptr().add(3)));
                simd.store(self.0.as_mut_ptr().add(S::LANES), simd.add_pairs(first, second));
            }
        }
    }

    #[test]
    fn pairs_go_to_neighbouring_lanes_and_are_added_there_on_every_set() {
        for set in InstructionSet::available() {
            let mut found = Vec::new();
            set.run(Pairs(&mut found));
            let square = |value: usize| (value * value) as f32;
            let pair = (0..set.lanes()).map(|lane| square(3 + lane % 2));
            let sums = (0..set.lanes()).map(|lane| square(2 * lane) + square(2 * lane + 1));
            let mut expected: Vec<f32> = pair.chain(sums).collect();
            assert_eq!(found, expected, "{}", set.name());
            expected.swap(set.lanes(), set.lanes() + 1);
            assert_ne!(found, expected, "two lanes that changed places are seen");
        }
    }

    /// Writes the factors of a vector of fractions and those of their halves, and one sum of the products of both and 1.
    struct Factors<'a>(&'a mut Vec<f32>);

    fn fraction(index: usize) -> f32 {
        97.3 * (index as f32 - 5.0)
    }

    impl Task for Factors<'_> {
        #[inline(always)]
        fn run<S: Simd>(self, simd: S) {
            let words = 2 * S::LANES / S::FACTORS;
            let values: Vec<f32> = (0..2 * S::LANES).map(fraction).collect();
            let [mut a, mut b] = [vec![0.0; 2 * S::LANES], vec![0.0; 2 * S::LANES]];
            let half = simd.splat(0.5);
            let mut sums = vec![0.0; S::LANES];
            // SAFETY: `values` holds two vectors, `a` and `b` as many words, and `sums` a vector.
            unsafe {
                for vector in 0..2 {
                    let (from, to) = (vector * S::LANES, vector * S::LANES / S::FACTORS);
                    let value = simd.load(values.as_ptr().add(from));
                    simd.store_factors(a.as_mut_ptr().add(to), value);
                    simd.store_factors(b.as_mut_ptr().add(to), simd.mul(half, value));
                }
                let one = simd.splat(if S::INTEGERS { f32::from_bits(1) } else { 1.0 });
                let sum = simd.mul_add_factors(simd.load(a.as_ptr()), simd.load(b.as_ptr()), one);
                simd.store(sums.as_mut_ptr(), simd.values_of_sums(sum));
            }
            self.0.extend(a[..words].iter().chain(&b[..words]).chain(&sums));
        }
    }

    #[test]
    fn factors_are_rounded_in_pairs_and_their_products_added_with_32_bits() {
        for products in Products::available() {
            let (lanes, factors) = (products.set().lanes(), products.factors());
            let mut found = Vec::new();
            products.run(Factors(&mut found));
            let kept = |index: usize, share: f32| {
                let value = share * fraction(index);
                match (factors, products.integers()) {
                    (1, _) => value,
                    (_, false) => half::bf16::from_f32(value).to_f32(),
                    (_, true) => value.round_ties_even(),
                }
            };
            let words = 2 * lanes / factors;
            for (word, share) in (0..2 * words).map(|word| (word, if word < words { 1.0 } else { 0.5 })) {
                let expected: Vec<_> =
                    (0..factors).map(|factor| kept(word % words * factors + factor, share)).collect();
                assert_eq!(products.factors_of(found[word]), expected, "word {word} on {}", products.name());
                let mut set = 0.0;
                (0..factors).rev().for_each(|factor| {
                    products.set_factor(&mut set, factor, share * fraction(word % words * factors + factor));
                });
                assert_eq!(products.factors_of(set), expected, "word {word} set on {}", products.name());
            }
            for (lane, found) in found[2 * words..].iter().enumerate() {
                let products_of = |index: usize| f64::from(kept(index, 1.0)) * f64::from(kept(index, 0.5));
                let expected = 1.0 + (0..factors).map(|factor| products_of(lane * factors + factor)).sum::<f64>();
                let error = |expected: f64| (f64::from(*found) - expected).abs();
                assert!(error(expected) < 1e-6 * expected, "lane {lane} on {}: {found}", products.name());
                assert!(error(expected + 1e-5 * expected) > 1e-6 * expected, "the comparison is blind");
            }
        }
    }

    /// Writes what each operation on squares and on lanes makes of values that are all different, one after another.
    struct Moves<'a>(&'a mut Vec<f32>);

    impl Task for Moves<'_> {
        #[inline(always)]
        fn run<S: Simd>(self, simd: S) {
            let lanes = S::LANES;
            let square: Vec<f32> = (0..lanes * (lanes + 3)).map(|value| value as f32).collect();
            let mut transposed = vec![0.0; lanes * (lanes + 1)];
            // SAFETY: rows of LANES values lie so far apart in both.
            unsafe { simd.transpose(square.as_ptr(), transposed.as_mut_ptr(), [lanes + 3, lanes + 1]) };
            let [a, b] = [simd.read(&square[1..]), simd.read(&square[20..])];
            let four = simd.splat(4.0);
            let no_number = simd.larger_magnitude(simd.larger_magnitude(four, simd.splat(-f32::NAN)), b);
            let vectors = [
                simd.unzip(a, b)[0],
                simd.unzip(a, b)[1],
                simd.where_equal(a, four, b),
                simd.neg_mul_add(a, b, four),
                simd.div(b, four),
                simd.sqrt(simd.mul(b, b)),
                simd.max(simd.splat(f32::NAN), b),
                simd.max(a, four),
                simd.larger_magnitude(four, simd.sub(a, simd.splat(9.0))),
                simd.where_equal(no_number, no_number, b),
            ];
            self.0.extend(&transposed);
            for vector in vectors {
                let mut to = vec![0.0; lanes];
                simd.write(&mut to, vector);
                self.0.extend(to);
            }
        }
    }

    #[test]
    fn squares_are_transposed_and_lanes_chosen_alike_on_every_set() {
        for set in InstructionSet::available() {
            let (lanes, mut found) = (set.lanes(), Vec::new());
            set.run(Moves(&mut found));
            let mut expected = vec![0.0; lanes * (lanes + 1)];
            for (row, column) in (0..lanes).flat_map(|row| (0..lanes).map(move |column| (row, column))) {
                expected[column * (lanes + 1) + row] = (row * (lanes + 3) + column) as f32;
            }
            let (a, b) = (|lane: usize| (1 + lane) as f32, |lane: usize| (20 + lane) as f32);
            let both = |lane: usize| if lane < lanes { a(lane) } else { b(lane - lanes) };
            expected.extend((0..2).flat_map(|odd| (0..lanes).map(move |lane| both(2 * lane + odd))));
            expected.extend((0..lanes).map(|lane| if a(lane) == 4.0 { b(lane) } else { 0.0 }));
            expected.extend((0..lanes).map(|lane| 4.0 - a(lane) * b(lane)));
            expected.extend((0..lanes).map(|lane| b(lane) / 4.0));
            expected.extend((0..2).flat_map(|_| (0..lanes).map(b)));
            expected.extend((0..lanes).map(|lane| a(lane).max(4.0)));
            expected.extend((0..lanes).map(|lane| (a(lane) - 9.0).abs().max(4.0)));
            expected.extend((0..lanes).map(|_| 0.0));
            assert_eq!(found, expected, "{}", set.name());
            expected.swap(1, lanes + 2);
            assert_ne!(found, expected, "two values that changed places are seen");
        }
    }
}
