// Double phase; optics/double_phase.rs says what it does and why. After these constants and phase_math.wgsl:
// WIDTH, HEIGHT, AMPLITUDE_SCALE, those of double_phase.rs, and SIDE: the edge of what a workgroup of `phases` does.

@group(0) @binding(0) var<storage, read> field: array<vec2f>; // [3, height, width]
@group(0) @binding(1) var<storage, read_write> errors: array<vec2f>; // [3, height, width]
@group(0) @binding(2) var<storage, read_write> clipped_samples: array<atomic<u32>, 3>;
@group(0) @binding(3) var<storage, read_write> phases_rad: array<f32>; // [3, height, width]

// Edge of the blocks of a thread, in pixels.
const BLOCK: u32 = 4;
const THREADS: u32 = (TILE / BLOCK) * (TILE / BLOCK);

struct Clipped {
    value: vec2f,
    inside: bool,
}

// a = c/K within the unit circle; dark where it, or its square, is not finite.
fn clipped(sample: vec2f) -> Clipped {
    let a = sample * AMPLITUDE_SCALE;
    let intensity = dot(a, a);
    // By its bits: a compiler may take it for granted that nothing is infinite.
    let finite = (bitcast<u32>(intensity) & 0x7f800000u) != 0x7f800000u;
    let inside = finite && intensity <= 1.0;
    let scaled = a * select(inverseSqrt(intensity), 1.0, inside);
    return Clipped(select(vec2f(0.0), scaled, finite), inside);
}

fn times(a: vec2f, b: vec2f) -> vec2f {
    return vec2f(a.x * b.x - a.y * b.y, a.x * b.y + a.y * b.x);
}

fn unit(value: vec2f) -> vec2f {
    return value / sqrt(max(dot(value, value), 1e-30));
}

var<workgroup> powers: array<f32, THREADS>;
var<workgroup> outside: atomic<u32>;

// One tile of one colour: what is left of a without the phasor of its pair.
@compute @workgroup_size(THREADS)
fn pair_errors(@builtin(workgroup_id) tile: vec3u, @builtin(local_invocation_index) thread: u32) {
    let left = tile.x * TILE + thread % (TILE / BLOCK) * BLOCK;
    let top = tile.y * TILE + thread / (TILE / BLOCK) * BLOCK;
    let plane = tile.z * WIDTH * HEIGHT;

    var a: array<vec2f, 16>;
    var power = 0.0;
    var count = 0u;
    for (var pixel = 0u; pixel < 16u; pixel++) {
        let x = left + pixel % 4u;
        let y = top + pixel / 4u;
        a[pixel] = vec2f(0.0);
        if x < WIDTH && y < HEIGHT {
            let sample = clipped(field[plane + y * WIDTH + x]);
            a[pixel] = sample.value;
            count += u32(!sample.inside);
        }
        power += dot(a[pixel], a[pixel]);
    }
    powers[thread] = power;
    atomicAdd(&outside, count);
    workgroupBarrier();
    var tile_power = 0.0;
    for (var other = 0u; other < THREADS; other++) {
        tile_power += powers[other];
    }
    if thread == 0u && atomicLoad(&outside) > 0u {
        atomicAdd(&clipped_samples[tile.z], atomicLoad(&outside));
    }
    let dark = clamp(DARK_SHARE * sqrt(tile_power / f32(TILE * TILE)), LEAST_DARK, MOST_DARK);
    let floor = dark * dark * dark;

    // Means of the quarters, weighted by intensity, and the phase of the whole block's.
    var quarters: array<vec2f, 4>;
    for (var quarter = 0u; quarter < 4u; quarter++) {
        let first = quarter / 2u * 8u + quarter % 2u * 2u;
        var sum = vec2f(0.0);
        for (var corner = 0u; corner < 4u; corner++) {
            let value = a[first + corner / 2u * 4u + corner % 2u];
            sum += dot(value, value) * value;
        }
        quarters[quarter] = 0.25 * sum;
    }
    let mean = 0.25 * (quarters[0] + quarters[1] + quarters[2] + quarters[3]);
    let block = unit(mean + vec2f(0.125 * LEAST_DARK * LEAST_DARK * LEAST_DARK, 0.0));
    for (var quarter = 0u; quarter < 4u; quarter++) {
        quarters[quarter] = unit(quarters[quarter] + floor * block);
    }

    for (var pixel = 0u; pixel < 16u; pixel++) {
        let x = left + pixel % 4u;
        let y = top + pixel / 4u;
        if x >= WIDTH || y >= HEIGHT {
            continue;
        }
        let value = a[pixel];
        // The carrier at its own length.
        let carrier = dot(value, value) * value + floor * quarters[pixel / 8u * 2u + pixel % 4u / 2u];
        let square = max(dot(carrier, carrier), 1e-30);
        let along = dot(value, carrier);
        let across = sqrt(max(square - along * along, 0.0));
        let pair = vec2f(along, select(-across, across, (x + y) % 2u == 1u));
        errors[plane + y * WIDTH + x] = value - times(carrier, pair) / square;
    }
}

// With what the binomial filter 1 4 6 4 1 reaches.
const AROUND: u32 = SIDE + 2 * REACH;

var<workgroup> around: array<vec2f, AROUND * AROUND>;
var<workgroup> columns: array<vec2f, AROUND * SIDE>;

// Where the sample `padded` - REACH of `count` is, mirrored about the outermost ones, which keeps a checkerboard one.
// What is farther off than `count` is the nearest.
fn mirrored(padded: u32, count: u32) -> u32 {
    let inside = select(REACH - padded, padded - REACH, padded >= REACH);
    if inside < count {
        return inside;
    }
    let limit = 2u * (count - 1u);
    return min(select(0u, limit - inside, limit >= inside), count - 1u);
}

fn binomial(a: vec2f, b: vec2f, c: vec2f, d: vec2f, e: vec2f) -> vec2f {
    return 0.375 * c + 0.25 * (b + d) + 0.0625 * (a + e);
}

// The phases of a corrected by what the errors have in the band.
@compute @workgroup_size(SIDE, SIDE)
fn phases(
    @builtin(workgroup_id) part: vec3u,
    @builtin(local_invocation_id) place: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let plane = part.z * WIDTH * HEIGHT;
    for (var index = thread; index < AROUND * AROUND; index += SIDE * SIDE) {
        let x = mirrored(part.x * SIDE + index % AROUND, WIDTH);
        let y = mirrored(part.y * SIDE + index / AROUND, HEIGHT);
        around[index] = errors[plane + y * WIDTH + x];
    }
    workgroupBarrier();
    for (var index = thread; index < AROUND * SIDE; index += SIDE * SIDE) {
        columns[index] = binomial(
            around[index], around[index + AROUND], around[index + 2u * AROUND], around[index + 3u * AROUND],
            around[index + 4u * AROUND],
        );
    }
    workgroupBarrier();
    let x = part.x * SIDE + place.x;
    let y = part.y * SIDE + place.y;
    if x >= WIDTH || y >= HEIGHT {
        return;
    }
    let first = place.y * AROUND + place.x;
    let in_band = binomial(columns[first], columns[first + 1u], columns[first + 2u], columns[first + 3u], columns[first + 4u]);
    let error = around[(place.y + REACH) * AROUND + place.x + REACH];
    let index = plane + y * WIDTH + x;
    let phasor = clipped(field[index]).value - error + CORRECTION_GAIN * in_band;
    let phase = argument(phasor);
    let turned = select(phase, phase + 2.0 * PI, phase < 0.0);
    phases_rad[index] = select(turned, 0.0, turned >= 2.0 * PI);
}
