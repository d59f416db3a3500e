// What a layer does with its sums; twin of Activation in ../cpu/conv.rs.

// Where the output has group `group` of pixel (x, y).
fn output_place(group: u32, x: u32, y: u32) -> u32 {
    let block = group / OUT_BLOCK * OUT_BLOCK;
    return ((y + 1u) * OUT_GROUPS + block) * OUT_PITCH + (x + 1u) * OUT_BLOCK + group % OUT_BLOCK;
}

// What is stored for a sum, where the map holds `skip`.
fn activated(sum: vec4f, skip: vec4f) -> vec4f {
    var value = sum;
    if RESIDUAL {
        value = fma(vec4f(0.5), value, skip);
    }
    if LEAKY {
        value = max(value, value * LEAKY_SLOPE);
    }
    return value;
}
