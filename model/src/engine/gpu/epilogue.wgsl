// What a layer does with its sums; twin of Activation in ../cpu/conv.rs. Needs the layer's map `output`
// of OutVector.

// Stores one group of channels of pixel (x, y), unless it is one of those that fill the last rows or the last part.
fn store(sum: vec4f, group: u32, x: u32, y: u32) {
    if y >= HEIGHT || group >= OUT_GROUPS {
        return;
    }
    let place = ((y + 1u) * OUT_GROUPS + group) * OUT_PITCH + x + 1u;
    var value = sum;
    if RESIDUAL {
        value = fma(vec4f(0.5), value, vec4f(output[place]));
    }
    if LEAKY {
        value = max(value, value * LEAKY_SLOPE);
    }
    output[place] = OutVector(value);
}
