// Circular transforms of lines of LENGTH samples, not normalised. A workgroup transforms LINES lines in its own memory:
// by Stockham's passes where LENGTH has no prime factor above 13, and else by Bluestein's chirps, over SPAN samples.
//
// A thread stores to and loads from `line` only the places item·THREADS + thread, below PLACES, item in 0..ITEMS; place
// p is sample p / LINES of line p % LINES. Nothing else has to be waited for around `transform`. Lines beyond the last
// one may hold anything.
//
// Before this file: LENGTH, SPAN, LINES, THREADS, BLUESTEIN and, for each radix, its rounds. After it: the passes of 7,
// 11 and 13 where they are needed, and `passes`.

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

fn pass2(stride: u32, direction: f32) {
    const COUNT = SPAN / 2u * LINES;
    var values: array<array<vec2f, 2>, ROUNDS_2>;
    for (var round = 0u; round < ROUNDS_2; round++) {
        let place = round * THREADS + thread;
        if (place < COUNT) {
            let a = line[place];
            let b = times(line[place + COUNT], turn(place, 2u, stride, direction));
            values[round] = array(a + b, a - b);
        }
    }
    workgroupBarrier();
    for (var round = 0u; round < ROUNDS_2; round++) {
        let place = round * THREADS + thread;
        if (place < COUNT) {
            let first = output(place, 2u, stride);
            line[first] = values[round][0];
            line[first + stride * LINES] = values[round][1];
        }
    }
    workgroupBarrier();
}

fn pass3(stride: u32, direction: f32) {
    const COUNT = SPAN / 3u * LINES;
    const SINE = 0.8660254037844386f;
    var values: array<array<vec2f, 3>, ROUNDS_3>;
    for (var round = 0u; round < ROUNDS_3; round++) {
        let place = round * THREADS + thread;
        if (place < COUNT) {
            let once = turn(place, 3u, stride, direction);
            let a = line[place];
            let b = times(line[place + COUNT], once);
            let c = times(line[place + 2u * COUNT], times(once, once));
            let even = a - 0.5f * (b + c);
            let odd = quarter_turn(SINE * (b - c), direction);
            values[round] = array(a + b + c, even + odd, even - odd);
        }
    }
    workgroupBarrier();
    for (var round = 0u; round < ROUNDS_3; round++) {
        let place = round * THREADS + thread;
        if (place < COUNT) {
            let first = output(place, 3u, stride);
            for (var part = 0u; part < 3u; part++) {
                line[first + part * stride * LINES] = values[round][part];
            }
        }
    }
    workgroupBarrier();
}

fn pass4(stride: u32, direction: f32) {
    const COUNT = SPAN / 4u * LINES;
    var values: array<array<vec2f, 4>, ROUNDS_4>;
    for (var round = 0u; round < ROUNDS_4; round++) {
        let place = round * THREADS + thread;
        if (place < COUNT) {
            let once = turn(place, 4u, stride, direction);
            let twice = times(once, once);
            let a = line[place];
            let b = times(line[place + COUNT], once);
            let c = times(line[place + 2u * COUNT], twice);
            let d = times(line[place + 3u * COUNT], times(once, twice));
            let odd = quarter_turn(b - d, direction);
            values[round] = array(a + c + (b + d), a - c + odd, a + c - (b + d), a - c - odd);
        }
    }
    workgroupBarrier();
    for (var round = 0u; round < ROUNDS_4; round++) {
        let place = round * THREADS + thread;
        if (place < COUNT) {
            let first = output(place, 4u, stride);
            for (var part = 0u; part < 4u; part++) {
                line[first + part * stride * LINES] = values[round][part];
            }
        }
    }
    workgroupBarrier();
}

fn pass5(stride: u32, direction: f32) {
    const COUNT = SPAN / 5u * LINES;
    const COSINE = 0.30901699437494745f;
    const COSINE_TWICE = -0.8090169943749475f;
    const SINE = 0.9510565162951535f;
    const SINE_TWICE = 0.5877852522924731f;
    var values: array<array<vec2f, 5>, ROUNDS_5>;
    for (var round = 0u; round < ROUNDS_5; round++) {
        let place = round * THREADS + thread;
        if (place < COUNT) {
            let once = turn(place, 5u, stride, direction);
            let twice = times(once, once);
            let a = line[place];
            let b = times(line[place + COUNT], once);
            let c = times(line[place + 2u * COUNT], twice);
            let d = times(line[place + 3u * COUNT], times(once, twice));
            let e = times(line[place + 4u * COUNT], times(twice, twice));
            let even = a + COSINE * (b + e) + COSINE_TWICE * (c + d);
            let even_twice = a + COSINE_TWICE * (b + e) + COSINE * (c + d);
            let odd = quarter_turn(SINE * (b - e) + SINE_TWICE * (c - d), direction);
            let odd_twice = quarter_turn(SINE_TWICE * (b - e) - SINE * (c - d), direction);
            values[round] =
                array(a + (b + e) + (c + d), even + odd, even_twice + odd_twice, even_twice - odd_twice, even - odd);
        }
    }
    workgroupBarrier();
    for (var round = 0u; round < ROUNDS_5; round++) {
        let place = round * THREADS + thread;
        if (place < COUNT) {
            let first = output(place, 5u, stride);
            for (var part = 0u; part < 5u; part++) {
                line[first + part * stride * LINES] = values[round][part];
            }
        }
    }
    workgroupBarrier();
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
