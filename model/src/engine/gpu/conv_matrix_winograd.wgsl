// As conv_winograd.wgsl, by products of matrices: of what 16 columns have at one point, by 16 input channels, with these
// by 16 output channels.
//
// A workgroup makes four rows of 16 columns by two blocks of output channels. It holds one block of the input at a time
// at the points in its memory, and sums there in registers. Lines that begin with `each` stand for themselves with all
// values of the names that follow.

@group(0) @binding(0) var<storage, read> input: array<vec4<f16>>;
// The bias of each output, then the weights: [part, column, input block, point, output block, output, input channel].
@group(0) @binding(1) var<storage, read> parameters: array<vec4<f16>>;
@group(0) @binding(2) var<storage, read_write> output: array<OutVector>;

// Columns of the input that those of the workgroup read, as vectors.
const COLUMNS = 18u * 4u;

// [point, column, input channel].
var<workgroup> points: array<vec4<f16>, POINTS * COLUMNS>;
// As in conv_matrix.wgsl.
var<workgroup> finished: array<vec4f, ROWS * 2u * 64u>;

@compute @workgroup_size(THREADS)
fn convolve(at: Invocation) {
    lane = at.index % 32u;
    let part = at.workgroup.x % PARTS;
    let first_x = at.workgroup.x / PARTS * 16u;
    let first_y = at.workgroup.y * ROWS;

    each line, block: var sums_{line}_{block} = Sums();
    for (var input_block = 0u; input_block < INPUT_BLOCKS; input_block++) {
        // The pixel above and to the left.
        let pixel = (first_y * IN_GROUPS + input_block * IN_BLOCK) * IN_PITCH + first_x * IN_BLOCK;
        workgroupBarrier();
        for (var place = at.index; place < COLUMNS; place += THREADS) {
            var rows: array<Vector, POINTS>;
            for (var row = 0u; row < POINTS; row++) {
                rows[row] = input[pixel + row * IN_GROUPS * IN_PITCH + place];
            }
            var values = at_points(rows);
            for (var point = 0u; point < POINTS; point++) {
                points[point * COLUMNS + place] = values[point];
            }
        }
        workgroupBarrier();
        for (var column = 0u; column < 3u; column++) {
            let weight = PARTS * 8u + ((part * 3u + column) * INPUT_BLOCKS + input_block) * POINTS * 128u;
            each line: let pixels_{line} = load_pixels({line}u * COLUMNS + column * IN_BLOCK);
            each block, line: if is_own(at, {block}u) { sums_{line}_{block} = multiply_add(pixels_{line}, load_weights(weight + (2u * {line}u + {block}u) * 64u), sums_{line}_{block}); }
        }
    }

    // As store_rows in winograd.wgsl.
    const SQUARE_A = POINT_A * POINT_A;
    const SQUARE_B = POINT_B * POINT_B;
    each block: let even_a_{block} = combined(1f, sums_1_{block}, sums_2_{block});
    each block: let even_b_{block} = combined(1f, sums_3_{block}, sums_4_{block});
    each block: let odd_a_{block} = combined(-1f, sums_2_{block}, sums_1_{block});
    each block: let odd_b_{block} = combined(-1f, sums_4_{block}, sums_3_{block});
    each block: let row_0_{block} = combined(1f, sums_0_{block}, combined(1f, even_a_{block}, even_b_{block}));
    each block: let row_1_{block} = scaled(POINT_B, combined(POINT_A / POINT_B, odd_a_{block}, odd_b_{block}));
    each block: let row_2_{block} = scaled(SQUARE_B, combined(SQUARE_A / SQUARE_B, even_a_{block}, even_b_{block}));
    each block: let high_{block} = combined(SQUARE_B * POINT_B, odd_b_{block}, sums_5_{block});
    each block: let row_3_{block} = combined(SQUARE_A * POINT_A, odd_a_{block}, high_{block});
    each row, block: if is_own(at, {block}u) { store_sums(row_{row}_{block}, ({row}u * 2u + {block}u) * 64u); }
    workgroupBarrier();

    // What this thread finishes of each block: two groups of one column, in some of the rows.
    let x = first_x + lane / 2u;
    let group = part * 8u + lane % 2u * 2u;
    for (var row = at.index / 32u; row < ROWS; row += THREADS / 32u) {
        each block: finish(row * 2u + {block}u, skipped(group + 4u * {block}u, x, first_y + row), group + 4u * {block}u, x, first_y + row);
    }
}
