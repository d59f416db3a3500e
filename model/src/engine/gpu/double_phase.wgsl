// Double phase; optics/double_phase.rs says what it does and why. After these constants, how buffers hold complex
// numbers, and phase_math.wgsl: WIDTH, HEIGHT, AMPLITUDE_SCALE, and those of double_phase.rs.

@group(0) @binding(0) var<storage, read> field: array<Stored>; // [3, height, width]
@group(0) @binding(1) var<storage, read_write> tile_powers: array<f32>; // [3, tiles down, tiles across]
@group(0) @binding(2) var<storage, read_write> clipped_samples: array<atomic<u32>, 3>;
@group(0) @binding(3) var<storage, read_write> phases_rad: array<f32>; // [3, height, width]

// Edge of the blocks of a thread, in pixels.
const BLOCK: u32 = 4;
const TILE_THREADS: u32 = (TILE / BLOCK) * (TILE / BLOCK);
const TILES_ACROSS: u32 = (WIDTH + TILE - 1) / TILE;
const TILES_DOWN: u32 = (HEIGHT + TILE - 1) / TILE;

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

var<workgroup> powers: array<f32, TILE_THREADS>;
var<workgroup> outside: atomic<u32>;

// The sum of intensities of one tile of one colour, and how many of its samples are clipped.
@compute @workgroup_size(TILE_THREADS)
fn measure_tiles(@builtin(workgroup_id) tile: vec3u, @builtin(local_invocation_index) thread: u32) {
    // Neighbouring threads read neighbouring columns.
    let x = tile.x * TILE + thread % TILE;
    let plane = tile.z * WIDTH * HEIGHT;
    var power = 0.0;
    var count = 0u;
    for (var row = thread / TILE; row < TILE; row += TILE_THREADS / TILE) {
        let y = tile.y * TILE + row;
        if x < WIDTH && y < HEIGHT {
            let sample = clipped(loaded(field[plane + y * WIDTH + x]));
            power += dot(sample.value, sample.value);
            count += u32(!sample.inside);
        }
    }
    powers[thread] = power;
    if count > 0u {
        atomicAdd(&outside, count);
    }
    workgroupBarrier();
    if thread == 0u {
        var tile_power = 0.0;
        for (var other = 0u; other < TILE_THREADS; other++) {
            tile_power += powers[other];
        }
        tile_powers[(tile.z * TILES_DOWN + tile.y) * TILES_ACROSS + tile.x] = tile_power;
        if atomicLoad(&outside) > 0u {
            atomicAdd(&clipped_samples[tile.z], atomicLoad(&outside));
        }
    }
}

// What a workgroup of `phases` does: blocks across and down, less one at each edge, of which it needs the errors only.
const THREADS: u32 = BLOCKS_ACROSS * BLOCKS_DOWN;
const ACROSS: u32 = (BLOCKS_ACROSS - 2) * BLOCK;
const DOWN: u32 = (BLOCKS_DOWN - 2) * BLOCK;
// Rows of a column that a thread does.
const STRIP: u32 = DOWN / STRIPS;
// With what the binomial filter 1 4 6 4 1 reaches.
const ERRORS_ACROSS: u32 = ACROSS + 2 * REACH;
const ERRORS_DOWN: u32 = DOWN + 2 * REACH;

// What is left of a without the phasor of its pair.
var<workgroup> errors: array<vec2f, ERRORS_ACROSS * ERRORS_DOWN>;

// Those of the block at (left, top), as far as they are needed.
fn find_errors(left: u32, top: u32, colour: u32, block_x: u32, block_y: u32) {
    var a: array<vec2f, 16>;
    let first = (colour * HEIGHT + top) * WIDTH + left;
    for (var pixel = 0u; pixel < 16u; pixel++) {
        a[pixel] = vec2f(0.0);
        if left + pixel % 4u < WIDTH && top + pixel / 4u < HEIGHT {
            a[pixel] = clipped(loaded(field[first + pixel / 4u * WIDTH + pixel % 4u])).value;
        }
    }
    let tile_power = tile_powers[(colour * TILES_DOWN + top / TILE) * TILES_ACROSS + left / TILE];
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

    // Left of and above what is needed these wrap round to what is too large.
    let first_x = block_x * BLOCK + REACH - BLOCK;
    let first_y = block_y * BLOCK + REACH - BLOCK;
    let first_error = first_y * ERRORS_ACROSS + first_x;
    for (var pixel = 0u; pixel < 16u; pixel++) {
        let value = a[pixel];
        // The carrier at its own length.
        let carrier = dot(value, value) * value + floor * quarters[pixel / 8u * 2u + pixel % 4u / 2u];
        let square = max(dot(carrier, carrier), 1e-30);
        let along = dot(value, carrier);
        let across = sqrt(max(square - along * along, 0.0));
        let pair = vec2f(along, select(-across, across, (pixel % 4u + pixel / 4u) % 2u == 1u));
        if first_x + pixel % 4u < ERRORS_ACROSS && first_y + pixel / 4u < ERRORS_DOWN {
            errors[first_error + pixel / 4u * ERRORS_ACROSS + pixel % 4u] = value - times(carrier, pair) / square;
        }
    }
}

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

// Row `padded` - REACH of the errors through the filter, around these columns. Beyond the last row that one of the
// image needs, all are that one.
fn filtered_row(columns: array<u32, 5>, padded: u32, top: u32) -> vec2f {
    let row = mirrored(min(padded, HEIGHT + 2u * REACH - 1u), HEIGHT) + REACH - top;
    let first = row * ERRORS_ACROSS;
    return binomial(
        errors[first + columns[0]],
        errors[first + columns[1]],
        errors[first + columns[2]],
        errors[first + columns[3]],
        errors[first + columns[4]],
    );
}

// The phases of a corrected by what the errors have in the band.
@compute @workgroup_size(THREADS)
fn phases(@builtin(workgroup_id) part: vec3u, @builtin(local_invocation_index) thread: u32) {
    let left = part.x * ACROSS;
    let top = part.y * DOWN;
    let block_x = thread % BLOCKS_ACROSS;
    let block_y = thread / BLOCKS_ACROSS;
    // What is left of the image or above it wraps round to what is too large.
    let block_left = left + block_x * BLOCK - BLOCK;
    let block_top = top + block_y * BLOCK - BLOCK;
    if block_left < WIDTH && block_top < HEIGHT {
        find_errors(block_left, block_top, part.z, block_x, block_y);
    }
    workgroupBarrier();
    let x = left + thread % ACROSS;
    let first_y = top + thread / ACROSS * STRIP;
    if thread >= ACROSS * STRIPS || x >= WIDTH || first_y >= HEIGHT {
        return;
    }
    var columns: array<u32, 5>;
    for (var tap = 0u; tap < 5u; tap++) {
        columns[tap] = mirrored(x + tap, WIDTH) + REACH - left;
    }
    // Rows of the filter: those before the first pixel's own, and one more for each pixel.
    var rows: array<vec2f, 2 * REACH + 1>;
    for (var row = 0u; row < 2u * REACH; row++) {
        rows[row + 1u] = filtered_row(columns, first_y + row, top);
    }
    var error_place = (first_y + REACH - top) * ERRORS_ACROSS + columns[REACH];
    var index = (part.z * HEIGHT + first_y) * WIDTH + x;
    for (var row = 0u; row < STRIP; row++) {
        let y = first_y + row;
        for (var tap = 0u; tap < 2u * REACH; tap++) {
            rows[tap] = rows[tap + 1u];
        }
        rows[2u * REACH] = filtered_row(columns, y + 2u * REACH, top);
        if y < HEIGHT {
            let in_band = binomial(rows[0], rows[1], rows[2], rows[3], rows[4]);
            let phasor = clipped(loaded(field[index])).value - errors[error_place] + CORRECTION_GAIN * in_band;
            let phase = argument(phasor);
            let turned = select(phase, phase + 2.0 * PI, phase < 0.0);
            phases_rad[index] = select(turned, 0.0, turned >= 2.0 * PI);
        }
        error_place += ERRORS_ACROSS;
        index += WIDTH;
    }
}
