// A 3x3 convolution of maps [row, group, column, 4], with bias, skip and leaky rectifier, by half of the products of
// conv.wgsl; twin of ../cpu/conv.rs, which saves products along rows, too.
//
// A thread makes four rows of one column by PART_GROUPS groups of output channels: it holds their sums at the points of
// winograd.wgsl in registers. Threads of a workgroup lie along x and multiply by the same weights at the same time.

@group(0) @binding(0) var<storage, read> input: array<InVector>;
// The bias of each group of outputs, filled up to whole elements, then the weights: [part, input group, column, point,
// input channel, output group]. Four vectors are an element because they are then loaded at once.
@group(0) @binding(1) var<storage, read> parameters: array<array<vec4f, 4>>;
@group(0) @binding(2) var<storage, read_write> output: array<OutVector>;

@compute @workgroup_size(WORKGROUP)
fn convolve(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) lane: u32) {
    let part = workgroup.x % PARTS;
    let x = workgroup.x / PARTS * WORKGROUP + lane;
    let y = workgroup.y * ROWS;

    var sums: array<array<vec4f, POINTS>, PART_GROUPS>;

    // The pixel above and to the left; threads beyond the last column read what that one reads.
    var pixel = y * IN_GROUPS * IN_PITCH + min(x, WIDTH - 1u);
    var weight = (PARTS * PART_GROUPS + 3u) / 4u + part * INPUT_GROUPS * 18u * PART_GROUPS;
    for (var input_group = 0u; input_group < INPUT_GROUPS; input_group++) {
        for (var column = 0u; column < 3u; column++) {
            var rows: array<Vector, POINTS>;
            for (var row = 0u; row < POINTS; row++) {
                rows[row] = Vector(input[pixel + column + row * IN_GROUPS * IN_PITCH]);
            }
            var values = at_points(rows);
            for (var point = 0u; point < POINTS; point++) {
                for (var channel = 0u; channel < 4u; channel++) {
                    for (var group = 0u; group < PART_GROUPS; group++) {
                        let place = (point * 4u + channel) * PART_GROUPS + group;
                        let factors = parameters[weight + place / 4u][place % 4u];
                        sums[group][point] = fma(Vector(values[point][channel]), factors, sums[group][point]);
                    }
                }
            }
            weight += 6u * PART_GROUPS;
        }
        pixel += IN_PITCH;
    }

    if x < WIDTH {
        for (var group = 0u; group < PART_GROUPS; group++) {
            let place = part * PART_GROUPS + group;
            store_rows(sums[group], parameters[place / 4u][place % 4u], place, x, y);
        }
    }
}
