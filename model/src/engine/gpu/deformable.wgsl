// A deformable 3x3 convolution of maps [row, group, column, 4]: every tap of every pixel is read at a place of its own; twin
// of ../cpu/deformable.rs.
//
// A thread makes PIXELS rows of one column by PART_GROUPS groups of output channels, which it holds in registers.

@group(0) @binding(0) var<storage, read> input: array<vec4f>;
// (dy, dx) of the nine taps, two to a group of channels.
@group(0) @binding(1) var<storage, read> offsets: array<vec2f>;
// The bias of each group of outputs, filled up to whole elements, then the weights: [part, tap, input group, input channel,
// output group]. Four vectors are an element because they are then loaded at once.
@group(0) @binding(2) var<storage, read> parameters: array<array<vec4f, 4>>;
@group(0) @binding(3) var<storage, read_write> output: array<vec4f>;

// Where one pixel reads at one tap: the upper left of four neighbours, and the share of each.
struct Place {
    corner: u32,
    shares: vec4f,
}

fn place_of(tap: u32, x: u32, y: u32) -> Place {
    let offset = offsets[(((y + 1u) * OFFSET_GROUPS + tap / 2u) * OFFSET_PITCH + x + 1u) * 2u + tap % 2u];
    let at = vec2f(f32(x + tap % 3u), f32(y + tap / 3u)) - 1.0 + offset.yx;
    let corner = floor(at);
    let share = at - corner;
    let horizontal = vec2f(1.0 - share.x, share.x);
    // In −1..WIDTH and −1..HEIGHT. NaN is outside too, where something is read without a share.
    let size = vec2f(f32(WIDTH), f32(HEIGHT));
    let inside = all(abs(at + 0.5 - 0.5 * size) < 0.5 + 0.5 * size);
    let shares = select(vec4f(), vec4f((1.0 - share.y) * horizontal, share.y * horizontal), inside);
    // The border makes all four neighbours readable.
    let first = min(vec2u(corner + 1.0), vec2u(WIDTH, HEIGHT));
    return Place(first.y * (IN_GROUPS * IN_PITCH) + first.x, shares);
}

@compute @workgroup_size(WORKGROUP)
fn convolve(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) lane: u32) {
    let part = workgroup.x % PARTS;
    let x = workgroup.x / PARTS * WORKGROUP + lane;
    let y = workgroup.y * PIXELS;

    var sums: array<array<vec4f, PART_GROUPS>, PIXELS>;
    for (var group = 0u; group < PART_GROUPS; group++) {
        let place = part * PART_GROUPS + group;
        let bias = parameters[place / 4u][place % 4u];
        for (var pixel = 0u; pixel < PIXELS; pixel++) {
            sums[pixel][group] = bias;
        }
    }

    var weight = (PARTS * PART_GROUPS + 3u) / 4u + part * 9u * INPUT_GROUPS * PART_GROUPS;
    for (var tap = 0u; tap < 9u; tap++) {
        var places: array<Place, PIXELS>;
        for (var pixel = 0u; pixel < PIXELS; pixel++) {
            // Threads beyond the last column read what that one reads.
            places[pixel] = place_of(tap, min(x, WIDTH - 1u), y + pixel);
        }
        for (var input_group = 0u; input_group < INPUT_GROUPS; input_group++) {
            var values: array<vec4f, PIXELS>;
            for (var pixel = 0u; pixel < PIXELS; pixel++) {
                let corner = places[pixel].corner + input_group * IN_PITCH;
                let below = corner + IN_GROUPS * IN_PITCH;
                let shares = places[pixel].shares;
                var value = shares.x * input[corner];
                value = fma(vec4f(shares.y), input[corner + 1u], value);
                value = fma(vec4f(shares.z), input[below], value);
                values[pixel] = fma(vec4f(shares.w), input[below + 1u], value);
            }
            for (var channel = 0u; channel < 4u; channel++) {
                for (var group = 0u; group < PART_GROUPS; group++) {
                    let place = channel * PART_GROUPS + group;
                    let factors = parameters[weight + place / 4u][place % 4u];
                    for (var pixel = 0u; pixel < PIXELS; pixel++) {
                        sums[pixel][group] = fma(vec4f(values[pixel][channel]), factors, sums[pixel][group]);
                    }
                }
            }
            weight += PART_GROUPS;
        }
    }

    if x < WIDTH {
        for (var pixel = 0u; pixel < PIXELS; pixel++) {
            for (var group = 0u; group < PART_GROUPS; group++) {
                store(sums[pixel][group], part * PART_GROUPS + group, x, y + pixel);
            }
        }
    }
}
