// As deformable.wgsl, in packed half precision: two products at once. What one tap gives is summed in half precision,
// and those sums in single precision.
//
// A thread makes ROWS rows of one column by PART_GROUPS groups of output channels, which it holds in registers.

@group(0) @binding(0) var<storage, read> input: array<InVector>;
// As in deformable.wgsl, with eight vectors to an element, and the weights of each tap filled up to whole elements.
@group(0) @binding(2) var<storage, read> parameters: array<array<vec4<f16>, 8>>;
@group(0) @binding(3) var<storage, read_write> output: array<OutVector>;

@compute @workgroup_size(WORKGROUP)
fn convolve(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) lane: u32) {
    let part = workgroup.x % PARTS;
    let x = workgroup.x / PARTS * WORKGROUP + lane;
    let y = workgroup.y * ROWS;

    var sums: array<array<vec4f, PART_GROUPS>, ROWS>;
    for (var group = 0u; group < PART_GROUPS; group++) {
        let place = part * PART_GROUPS + group;
        let bias = parameters[place / 8u][place % 8u];
        for (var pixel = 0u; pixel < ROWS; pixel++) {
            sums[pixel][group] = vec4f(bias);
        }
    }

    let tap_elements = (INPUT_GROUPS * 4u * PART_GROUPS + 7u) / 8u;
    var weight = (PARTS * PART_GROUPS + 7u) / 8u + part * 9u * tap_elements;
    for (var tap = 0u; tap < 9u; tap++) {
        var places: array<Place, ROWS>;
        for (var pixel = 0u; pixel < ROWS; pixel++) {
            // Threads beyond the last column read what that one reads.
            places[pixel] = place_of(tap, min(x, WIDTH - 1u), y + pixel);
        }
        var tap_sums: array<array<vec4<f16>, PART_GROUPS>, ROWS>;
        for (var input_group = 0u; input_group < INPUT_GROUPS; input_group++) {
            var values: array<vec4<f16>, ROWS>;
            for (var pixel = 0u; pixel < ROWS; pixel++) {
                let corner = places[pixel].corner + input_group * IN_PITCH;
                let below = corner + IN_GROUPS * IN_PITCH;
                let shares = vec4<f16>(places[pixel].shares);
                var value = shares.x * vec4<f16>(input[corner]);
                value = fma(vec4<f16>(shares.y), vec4<f16>(input[corner + 1u]), value);
                value = fma(vec4<f16>(shares.z), vec4<f16>(input[below]), value);
                values[pixel] = fma(vec4<f16>(shares.w), vec4<f16>(input[below + 1u]), value);
            }
            for (var channel = 0u; channel < 4u; channel++) {
                for (var group = 0u; group < PART_GROUPS; group++) {
                    let place = (input_group * 4u + channel) * PART_GROUPS + group;
                    let factors = parameters[weight + place / 8u][place % 8u];
                    for (var pixel = 0u; pixel < ROWS; pixel++) {
                        let value = vec4<f16>(values[pixel][channel]);
                        tap_sums[pixel][group] = fma(value, factors, tap_sums[pixel][group]);
                    }
                }
            }
        }
        for (var pixel = 0u; pixel < ROWS; pixel++) {
            for (var group = 0u; group < PART_GROUPS; group++) {
                sums[pixel][group] += vec4f(tap_sums[pixel][group]);
            }
        }
        weight += tap_elements;
    }

    if x < WIDTH {
        for (var pixel = 0u; pixel < ROWS; pixel++) {
            for (var group = 0u; group < PART_GROUPS; group++) {
                store(sums[pixel][group], part * PART_GROUPS + group, x, y + pixel);
            }
        }
    }
}
