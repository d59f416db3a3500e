// The field on the network's grid as the `direct` family has it. Before this file: WIDTH, HEIGHT,
// and how buffers hold complex numbers.

@group(0) @binding(1) var<storage, read> field_low: array<Stored>; // [3, height, width]

// All colours of sample (x, y).
fn low(x: u32, y: u32) -> array<vec2f, 3> {
    const PLANE = WIDTH * HEIGHT;
    let first = y * WIDTH + x;
    return array(loaded(field_low[first]), loaded(field_low[first + PLANE]), loaded(field_low[first + 2u * PLANE]));
}
