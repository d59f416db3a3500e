// As conv.wgsl, by products of matrices: of 16 pixels of a row by 16 input channels with these by 16 output channels.
//
// A workgroup makes ROWS rows of 16 columns by two blocks of output channels, whose sums it holds in registers. Lines
// that begin with `each` stand for themselves with all values of the names that follow: drivers keep no array of
// matrices in registers.

@group(0) @binding(0) var<storage, read> input: array<vec4<f16>>;
// The bias of each output, then the weights: [part, column, input block, row, output block, input channel, output].
@group(0) @binding(1) var<storage, read> parameters: array<vec4<f16>>;
@group(0) @binding(2) var<storage, read_write> output: array<OutVector>;

// Sums, so that each thread has all of its pixel's in the end: [row, output block, pixel, output].
var<workgroup> finished: array<vec4f, ROWS * 2u * 64u>;

@compute @workgroup_size(32)
fn convolve(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) index: u32) {
    lane = index;
    let part = workgroup.x % PARTS;
    let first_x = workgroup.x / PARTS * 16u;
    let first_y = workgroup.y * ROWS;
    // What this thread finishes of each block: two groups of one column.
    let x = first_x + lane / 2u;
    let group = part * 8u + lane % 2u * 2u;
    // These are asked for before the products, and have come when those are done.
    each row, block: let skip_{row}_{block} = skipped(group + 4u * {block}u, x, first_y + {row}u);

    each row, block: var sums_{row}_{block} = Sums();
    for (var column = 0u; column < 3u; column++) {
        for (var input_block = 0u; input_block < INPUT_BLOCKS; input_block++) {
            // The pixel above and to the left, and the rows below it.
            let pixel = (first_y * IN_GROUPS + input_block * IN_BLOCK) * IN_PITCH + (first_x + column) * IN_BLOCK;
            each line: let pixels_{line} = load_pixels(pixel + {line}u * IN_GROUPS * IN_PITCH);
            let weight = PARTS * 8u + ((part * 3u + column) * INPUT_BLOCKS + input_block) * 384u;
            each tap, block: let weights_{tap}_{block} = load_weights(weight + (2u * {tap}u + {block}u) * 64u);
            each tap, block, row: sums_{row}_{block} = multiply_add(pixels_{row+tap}, weights_{tap}_{block}, sums_{row}_{block});
        }
    }

    each row, block: store_sums(sums_{row}_{block}, ({row}u * 2u + {block}u) * 64u);
    workgroupBarrier();
    each row, block: finish({row}u * 2u + {block}u, skip_{row}_{block}, group + 4u * {block}u, x, first_y + {row}u);
}
