// As conv.wgsl, in packed half precision: two products at once. What one group of input channels gives is summed in
// half precision, and those sums in single precision.
//
// A thread makes ROWS rows of one column by PART_GROUPS groups of output channels, which it holds in registers. Threads
// of a workgroup lie along x and multiply by the same weights at the same time.

@group(0) @binding(0) var<storage, read> input: array<InVector>;
// As in conv.wgsl, with eight vectors to an element, and the weights of each input group filled up to whole elements.
@group(0) @binding(1) var<storage, read> parameters: array<array<vec4<f16>, 8>>;
@group(0) @binding(2) var<storage, read_write> output: array<OutVector>;

@compute @workgroup_size(WORKGROUP)
fn convolve(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) lane: u32) {
    let part = workgroup.x % PARTS;
    let x = workgroup.x / PARTS * WORKGROUP + lane;
    let y = workgroup.y * ROWS;

    var sums: array<array<vec4f, PART_GROUPS>, ROWS>;
    for (var group = 0u; group < PART_GROUPS; group++) {
        let place = part * PART_GROUPS + group;
        let bias = parameters[place / 8u][place % 8u];
        for (var row = 0u; row < ROWS; row++) {
            sums[row][group] = vec4f(bias);
        }
    }

    // The pixel above and to the left; threads beyond the last column read what that one reads.
    var pixel = y * IN_GROUPS * IN_PITCH + min(x, WIDTH - 1u);
    let group_elements = (36u * PART_GROUPS + 7u) / 8u;
    var weight = (PARTS * PART_GROUPS + 7u) / 8u + part * INPUT_GROUPS * group_elements;
    for (var input_group = 0u; input_group < INPUT_GROUPS; input_group++) {
        var group_sums: array<array<vec4<f16>, PART_GROUPS>, ROWS>;
        for (var column = 0u; column < 3u; column++) {
            var values: array<vec4<f16>, ROWS + 2u>;
            for (var row = 0u; row < ROWS + 2u; row++) {
                values[row] = vec4<f16>(input[pixel + column + row * IN_GROUPS * IN_PITCH]);
            }
            for (var tap = 0u; tap < 3u; tap++) {
                for (var channel = 0u; channel < 4u; channel++) {
                    for (var group = 0u; group < PART_GROUPS; group++) {
                        let place = (column * 12u + tap * 4u + channel) * PART_GROUPS + group;
                        let factors = parameters[weight + place / 8u][place % 8u];
                        for (var row = 0u; row < ROWS; row++) {
                            let value = vec4<f16>(values[row + tap][channel]);
                            group_sums[row][group] = fma(value, factors, group_sums[row][group]);
                        }
                    }
                }
            }
        }
        for (var row = 0u; row < ROWS; row++) {
            for (var group = 0u; group < PART_GROUPS; group++) {
                sums[row][group] += vec4f(group_sums[row][group]);
            }
        }
        weight += group_elements;
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
