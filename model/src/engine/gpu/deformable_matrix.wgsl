// As deformable.wgsl, by products of matrices: what 16 pixels of a row read at one tap, by 16 input channels, with
// these by 16 output channels.
//
// A workgroup makes ROWS rows of 16 columns by two blocks of output channels, whose sums it holds in registers. Lines
// that begin with `each` stand for themselves with all values of the names that follow.

@group(0) @binding(0) var<storage, read> input: array<vec4<f16>>;
// The bias of each output, then the weights: [part, tap, input block, output block, input channel, output].
@group(0) @binding(2) var<storage, read> parameters: array<vec4<f16>>;
@group(0) @binding(3) var<storage, read_write> output: array<OutVector>;

// What the pixels read at one tap: [row, input block, pixel, input channel].
var<workgroup> gathered: array<vec4<f16>, ROWS * INPUT_BLOCKS * 64u>;
// As in conv_matrix.wgsl.
var<workgroup> finished: array<vec4f, ROWS * 2u * 64u>;

// Eight channels of each block of the input, at one tap of one pixel.
fn gather(row: u32, tap: u32, x: u32, y: u32) {
    let place = place_of(tap, min(x, WIDTH - 1u), min(y, HEIGHT - 1u));
    let shares = vec4<f16>(place.shares);
    for (var block = 0u; block < INPUT_BLOCKS; block++) {
        for (var half = 0u; half < 2u; half++) {
            let part = lane % 2u * 2u + half;
            let corner = place.corner + block * IN_BLOCK * IN_PITCH + part;
            let below = corner + IN_GROUPS * IN_PITCH;
            var value = shares.x * input[corner];
            value = fma(vec4<f16>(shares.y), input[corner + IN_BLOCK], value);
            value = fma(vec4<f16>(shares.z), input[below], value);
            value = fma(vec4<f16>(shares.w), input[below + IN_BLOCK], value);
            gathered[((row * INPUT_BLOCKS + block) * 16u + lane / 2u) * 4u + part] = value;
        }
    }
}

@compute @workgroup_size(THREADS)
fn convolve(at: Invocation) {
    lane = at.index % 32u;
    let part = at.workgroup.x % PARTS;
    let first_y = at.workgroup.y * ROWS;
    // What this thread gathers, and finishes of each block: two groups of one column, in rows from `first_row` on.
    let first_row = at.index / 32u;
    let x = at.workgroup.x / PARTS * 16u + lane / 2u;
    let group = part * 8u + lane % 2u * 2u;

    each row, block: var sums_{row}_{block} = Sums();
    for (var tap = 0u; tap < 9u; tap++) {
        for (var row = first_row; row < ROWS; row += THREADS / 32u) {
            gather(row, tap, x, first_y + row);
        }
        workgroupBarrier();
        for (var input_block = 0u; input_block < INPUT_BLOCKS; input_block++) {
            each row: let pixels_{row} = load_pixels(({row}u * INPUT_BLOCKS + input_block) * 64u);
            let weight = PARTS * 8u + ((part * 9u + tap) * INPUT_BLOCKS + input_block) * 128u;
            each block: let weights_{block} = load_weights(weight + {block}u * 64u);
            each row, block: if is_own(at, {row}u) { sums_{row}_{block} = multiply_add(pixels_{row}, weights_{block}, sums_{row}_{block}); }
        }
        workgroupBarrier();
    }

    each row, block: if is_own(at, {row}u) { store_sums(sums_{row}_{block}, ({row}u * 2u + {block}u) * 64u); }
    workgroupBarrier();
    for (var row = first_row; row < ROWS; row += THREADS / 32u) {
        each block: finish(row * 2u + {block}u, skipped(group + 4u * {block}u, x, first_y + row), group + 4u * {block}u, x, first_y + row);
    }
}
