// As conv_winograd.wgsl, in packed half precision: two products at once. What TRIP groups of input channels give is
// summed in half precision, and those sums in single precision.
//
// A thread makes four rows of one column by PART_GROUPS groups of output channels: it holds their sums at the points of
// winograd.wgsl in registers. Threads of a workgroup lie along x and multiply by the same weights at the same time.

@group(0) @binding(0) var<storage, read> input: array<InVector>;
// As in conv_winograd.wgsl, with eight vectors to an element.
@group(0) @binding(1) var<storage, read> parameters: array<array<Vector, 8>>;
@group(0) @binding(2) var<storage, read_write> output: array<OutVector>;

@compute @workgroup_size(WORKGROUP)
fn convolve(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) lane: u32) {
    let part = workgroup.x % PARTS;
    let x = workgroup.x / PARTS * WORKGROUP + lane;
    let y = workgroup.y * ROWS;

    var sums: array<array<vec4f, POINTS>, PART_GROUPS>;

    // The pixel above and to the left; threads beyond the last column read what that one reads.
    var pixel = y * IN_GROUPS * IN_PITCH + min(x, WIDTH - 1u);
    let group_elements = 9u * PART_GROUPS;
    var weight = (PARTS * PART_GROUPS + 7u) / 8u + part * INPUT_GROUPS * group_elements;
    for (var trip = 0u; trip < INPUT_GROUPS / TRIP; trip++) {
        var trip_sums: array<array<Vector, POINTS>, PART_GROUPS>;
        for (var input_group = 0u; input_group < TRIP; input_group++) {
            for (var column = 0u; column < 3u; column++) {
                var rows: array<Vector, POINTS>;
                for (var row = 0u; row < POINTS; row++) {
                    rows[row] = Vector(input[pixel + column + row * IN_GROUPS * IN_PITCH]);
                }
                var values = at_points(rows);
                for (var point = 0u; point < POINTS; point++) {
                    for (var channel = 0u; channel < 4u; channel++) {
                        for (var group = 0u; group < PART_GROUPS; group++) {
                            let place = (column * 24u + point * 4u + channel) * PART_GROUPS + group;
                            let factors = parameters[weight + place / 8u][place % 8u];
                            let value = Vector(values[point][channel]);
                            trip_sums[group][point] = fma(value, factors, trip_sums[group][point]);
                        }
                    }
                }
            }
            weight += group_elements;
            pixel += IN_PITCH;
        }
        for (var group = 0u; group < PART_GROUPS; group++) {
            for (var point = 0u; point < POINTS; point++) {
                sums[group][point] += vec4f(trip_sums[group][point]);
            }
        }
    }

    if x < WIDTH {
        for (var group = 0u; group < PART_GROUPS; group++) {
            let place = part * PART_GROUPS + group;
            store_rows(sums[group], vec4f(parameters[place / 8u][place % 8u]), place, x, y);
        }
    }
}
