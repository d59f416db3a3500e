// As store_tile.wgsl, in an output of groups, each of which may be missing. Before this file: OutVector.

alias Skipped = array<vec4f, 2>;

fn skipped(group: u32, x: u32, y: u32) -> Skipped {
    var skip: Skipped;
    if RESIDUAL && x < WIDTH && y < HEIGHT {
        for (var part = 0u; part < 2u && group + part < OUT_GROUPS; part++) {
            skip[part] = vec4f(output[output_place(group + part, x, y)]);
        }
    }
    return skip;
}

fn store(sums: array<vec4f, 2>, skip: Skipped, group: u32, x: u32, y: u32) {
    if x < WIDTH && y < HEIGHT {
        for (var part = 0u; part < 2u && group + part < OUT_GROUPS; part++) {
            output[output_place(group + part, x, y)] = OutVector(activated(sums[part], skip[part]));
        }
    }
}
