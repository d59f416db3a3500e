// How one thread reads and writes eight channels of a pixel, two groups, in an output of matrices. Before this file:
// epilogue.wgsl.

alias OutVector = vec4<u32>;
alias Skipped = vec4<u32>;

// What the output holds of groups `group` and `group` + 1, if that takes part. Of pixels beyond the last ones it is
// anything.
fn skipped(group: u32, x: u32, y: u32) -> Skipped {
    if RESIDUAL {
        return output[output_place(group, x, y) / 2u];
    }
    return Skipped();
}

fn store(sums: array<vec4f, 2>, skip: Skipped, group: u32, x: u32, y: u32) {
    if x < WIDTH && y < HEIGHT && group < OUT_GROUPS {
        let first = activated(sums[0], vec4f(unpack2x16float(skip.x), unpack2x16float(skip.y)));
        let second = activated(sums[1], vec4f(unpack2x16float(skip.z), unpack2x16float(skip.w)));
        let low = vec2u(pack2x16float(first.xy), pack2x16float(first.zw));
        let high = vec2u(pack2x16float(second.xy), pack2x16float(second.zw));
        output[output_place(group, x, y) / 2u] = vec4u(low, high);
    }
}
