// Needs epilogue.wgsl and the layer's map `output` of OutVector.

// Stores one group of channels of pixel (x, y), unless it is one of those that fill the last rows or the last part.
fn store(sum: vec4f, group: u32, x: u32, y: u32) {
    if y >= HEIGHT || group >= OUT_GROUPS {
        return;
    }
    let place = output_place(group, x, y);
    var skip: vec4f;
    if RESIDUAL {
        skip = vec4f(output[place]);
    }
    output[place] = OutVector(activated(sum, skip));
}
