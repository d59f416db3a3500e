// Circular transforms of lines of LENGTH samples, not normalised. A workgroup transforms LINES lines in its own memory:
// by Stockham's passes where LENGTH has no prime factor above 13, and else by Bluestein's chirps, over SPAN samples.
//
// A thread stores to and loads from `line` only the places item·THREADS + thread, below PLACES, item in 0..ITEMS; place
// p is sample p / LINES of line p % LINES. Nothing else has to be waited for around `transform`; who touches places of
// other threads has barriers of its own. Lines beyond the last one may hold anything.
//
// UNITARY times a transform keeps the sum of squares: what buffers hold between passes is made of such transforms.
//
// Before this file: LENGTH, SPAN, LINES, THREADS, BLUESTEIN, UNITARY, and how buffers hold complex numbers. After it:
// the other butterflies, a pass for each radix, and `passes`, as fft.rs writes them.

const PLACES = LENGTH * LINES;
const ITEMS = (PLACES + THREADS - 1u) / THREADS;
const SPAN_ITEMS = (SPAN * LINES + THREADS - 1u) / THREADS;

const FORWARD = 1f;
const INVERSE = -1f;

// exp(-j·2π·t/SPAN); where there are chirps, LENGTH of them, exp(-j·π·s²/LENGTH), and the spectrum of their conjugates
// over SPAN.
@group(0) @binding(0) var<storage, read> turns: array<vec2f>;

var<workgroup> line: array<vec2f, SPAN * LINES>;
var<private> thread: u32;

// a·b.
fn times(a: vec2f, b: vec2f) -> vec2f {
    return vec2f(a.x * b.x - a.y * b.y, a.x * b.y + a.y * b.x);
}

// The signed frequency of bin `bin` among `bins`, in cycles a sample.
fn frequency(bin: u32, bins: u32) -> f32 {
    return (f32(bin) - select(f32(bins), 0f, 2u * bin < bins)) / f32(bins);
}

// -j·direction·a.
fn quarter_turn(a: vec2f, direction: f32) -> vec2f {
    return direction * vec2f(a.y, -a.x);
}

// The first turn of a butterfly whose input has gone through passes over `stride` samples; its others are powers of it.
fn turn(place: u32, radix: u32, stride: u32, direction: f32) -> vec2f {
    if (stride == 1u) {
        return vec2f(1f, 0f);
    }
    let root = turns[place / LINES % stride * (SPAN / (radix * stride))];
    return vec2f(root.x, direction * root.y);
}

// Where the first output of the butterfly of `place` goes; the others follow `stride`·LINES apart.
fn output(place: u32, radix: u32, stride: u32) -> u32 {
    let butterfly = place / LINES;
    let within = butterfly % stride;
    return ((butterfly - within) * radix + within) * LINES + place % LINES;
}

// Transforms of a few samples each.

fn butterfly2(x: array<vec2f, 2>, direction: f32) -> array<vec2f, 2> {
    return array(x[0] + x[1], x[0] - x[1]);
}

fn butterfly3(x: array<vec2f, 3>, direction: f32) -> array<vec2f, 3> {
    const SINE = 0.8660254037844386f;
    let even = x[0] - 0.5f * (x[1] + x[2]);
    let odd = quarter_turn(SINE * (x[1] - x[2]), direction);
    return array(x[0] + x[1] + x[2], even + odd, even - odd);
}

fn butterfly4(x: array<vec2f, 4>, direction: f32) -> array<vec2f, 4> {
    let low = x[0] + x[2];
    let high = x[1] + x[3];
    let difference = x[0] - x[2];
    let odd = quarter_turn(x[1] - x[3], direction);
    return array(low + high, difference + odd, low - high, difference - odd);
}

fn butterfly5(x: array<vec2f, 5>, direction: f32) -> array<vec2f, 5> {
    const COSINE = 0.30901699437494745f;
    const COSINE_TWICE = -0.8090169943749475f;
    const SINE = 0.9510565162951535f;
    const SINE_TWICE = 0.5877852522924731f;
    let outer = x[1] + x[4];
    let inner = x[2] + x[3];
    let even = x[0] + COSINE * outer + COSINE_TWICE * inner;
    let even_twice = x[0] + COSINE_TWICE * outer + COSINE * inner;
    let odd = quarter_turn(SINE * (x[1] - x[4]) + SINE_TWICE * (x[2] - x[3]), direction);
    let odd_twice = quarter_turn(SINE_TWICE * (x[1] - x[4]) - SINE * (x[2] - x[3]), direction);
    return array(x[0] + outer + inner, even + odd, even_twice + odd_twice, even_twice - odd_twice, even - odd);
}

// Transforms every line in `line`; `direction` is FORWARD or INVERSE.
fn transform(direction: f32) {
    if (BLUESTEIN) {
        for (var item = 0u; item < SPAN_ITEMS; item++) {
            let place = item * THREADS + thread;
            if (place < PLACES) {
                line[place] = times(line[place], chirp(place / LINES, direction));
            } else if (place < SPAN * LINES) {
                line[place] = vec2f();
            }
        }
        workgroupBarrier();
        passes(FORWARD);
        for (var item = 0u; item < SPAN_ITEMS; item++) {
            let place = item * THREADS + thread;
            if (place < SPAN * LINES) {
                let bin = turns[SPAN + LENGTH + place / LINES];
                line[place] = times(line[place], vec2f(bin.x, direction * bin.y));
            }
        }
        workgroupBarrier();
        passes(INVERSE);
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            if (place < PLACES) {
                line[place] = times(line[place], chirp(place / LINES, direction));
            }
        }
    } else {
        workgroupBarrier();
        passes(direction);
    }
}

fn chirp(sample: u32, direction: f32) -> vec2f {
    let value = turns[SPAN + sample];
    return vec2f(value.x, direction * value.y);
}
