// A deformable 3x3 convolution of maps [row, group, column, 4]: every tap of every pixel is read at a place of its own;
// twin of ../cpu/deformable.rs.
//
// A thread makes ROWS rows of one column by PART_GROUPS groups of output channels, which it holds in registers.

@group(0) @binding(0) var<storage, read> input: array<InVector>;
// The bias of each group of outputs, filled up to whole elements, then the weights: [part, tap, input group, input
// channel, output group]. Four vectors are an element because they are then loaded at once.
@group(0) @binding(2) var<storage, read> parameters: array<array<vec4f, 4>>;
@group(0) @binding(3) var<storage, read_write> output: array<OutVector>;

@compute @workgroup_size(WORKGROUP)
fn convolve(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) lane: u32) {
    let part = workgroup.x % PARTS;
    let x = workgroup.x / PARTS * WORKGROUP + lane;
    let y = workgroup.y * ROWS;

    var sums: array<array<vec4f, PART_GROUPS>, ROWS>;
    for (var group = 0u; group < PART_GROUPS; group++) {
        let place = part * PART_GROUPS + group;
        let bias = parameters[place / 4u][place % 4u];
        for (var pixel = 0u; pixel < ROWS; pixel++) {
            sums[pixel][group] = bias;
        }
    }

    var weight = (PARTS * PART_GROUPS + 3u) / 4u + part * 9u * INPUT_GROUPS * PART_GROUPS;
    for (var tap = 0u; tap < 9u; tap++) {
        var places: array<Place, ROWS>;
        for (var pixel = 0u; pixel < ROWS; pixel++) {
            // Threads beyond the last column read what that one reads.
            places[pixel] = place_of(tap, min(x, WIDTH - 1u), y + pixel);
        }
        for (var input_group = 0u; input_group < INPUT_GROUPS; input_group++) {
            var values: array<vec4f, ROWS>;
            for (var pixel = 0u; pixel < ROWS; pixel++) {
                let corner = places[pixel].corner + input_group * IN_PITCH;
                let below = corner + IN_GROUPS * IN_PITCH;
                let shares = places[pixel].shares;
                var value = shares.x * vec4f(input[corner]);
                value = fma(vec4f(shares.y), vec4f(input[corner + 1u]), value);
                value = fma(vec4f(shares.z), vec4f(input[below]), value);
                values[pixel] = fma(vec4f(shares.w), vec4f(input[below + 1u]), value);
            }
            for (var channel = 0u; channel < 4u; channel++) {
                for (var group = 0u; group < PART_GROUPS; group++) {
                    let place = channel * PART_GROUPS + group;
                    let factors = parameters[weight + place / 4u][place % 4u];
                    for (var pixel = 0u; pixel < ROWS; pixel++) {
                        sums[pixel][group] = fma(vec4f(values[pixel][channel]), factors, sums[pixel][group]);
                    }
                }
            }
            weight += PART_GROUPS;
        }
    }

    if x < WIDTH {
        for (var pixel = 0u; pixel < ROWS; pixel++) {
            for (var group = 0u; group < PART_GROUPS; group++) {
                store(sums[pixel][group], part * PART_GROUPS + group, x, y + pixel);
            }
        }
    }
}
