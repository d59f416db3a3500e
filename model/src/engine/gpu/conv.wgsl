// A 3x3 convolution of maps [row, group, column, 4], with bias, skip and leaky rectifier; twin of ../cpu/conv.rs.
//
// A thread makes ROWS rows of one column by PART_GROUPS groups of output channels, which it holds in registers. Threads
// of a workgroup lie along x and multiply by the same weights at the same time.

@group(0) @binding(0) var<storage, read> input: array<InVector>;
// The bias of each group of outputs, filled up to whole elements, then the weights: [part, input group, column, row,
// input channel, output group]. Four vectors are an element because they are then loaded at once.
@group(0) @binding(1) var<storage, read> parameters: array<array<vec4f, 4>>;
@group(0) @binding(2) var<storage, read_write> output: array<OutVector>;

@compute @workgroup_size(WORKGROUP)
fn convolve(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) lane: u32) {
    let part = workgroup.x % PARTS;
    let x = workgroup.x / PARTS * WORKGROUP + lane;
    let y = workgroup.y * ROWS;

    var sums: array<array<vec4f, PART_GROUPS>, ROWS>;
    for (var group = 0u; group < PART_GROUPS; group++) {
        let place = part * PART_GROUPS + group;
        let bias = parameters[place / 4u][place % 4u];
        for (var row = 0u; row < ROWS; row++) {
            sums[row][group] = bias;
        }
    }

    // The pixel above and to the left; threads beyond the last column read what that one reads.
    var pixel = y * IN_GROUPS * IN_PITCH + min(x, WIDTH - 1u);
    var weight = (PARTS * PART_GROUPS + 3u) / 4u + part * INPUT_GROUPS * 9u * PART_GROUPS;
    for (var input_group = 0u; input_group < INPUT_GROUPS; input_group++) {
        for (var column = 0u; column < 3u; column++) {
            var values: array<vec4f, ROWS + 2u>;
            for (var row = 0u; row < ROWS + 2u; row++) {
                values[row] = vec4f(input[pixel + column + row * IN_GROUPS * IN_PITCH]);
            }
            for (var tap = 0u; tap < 3u; tap++) {
                for (var channel = 0u; channel < 4u; channel++) {
                    for (var group = 0u; group < PART_GROUPS; group++) {
                        let place = (tap * 4u + channel) * PART_GROUPS + group;
                        let factors = parameters[weight + place / 4u][place % 4u];
                        for (var row = 0u; row < ROWS; row++) {
                            sums[row][group] = fma(vec4f(values[row + tap][channel]), factors, sums[row][group]);
                        }
                    }
                }
            }
            weight += 3u * PART_GROUPS;
        }
        pixel += IN_PITCH;
    }

    if x < WIDTH {
        for (var row = 0u; row < ROWS; row++) {
            for (var group = 0u; group < PART_GROUPS; group++) {
                store(sums[row][group], part * PART_GROUPS + group, x, y + row);
            }
        }
    }
}
