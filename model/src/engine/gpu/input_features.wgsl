// What the nets of `expected-stack` are told of a frame, as input_features.rs writes it. Before this file:
// FRAME_WIDTH, FRAME_HEIGHT and blocks.wgsl; after it: `frame`.

// The eye's pupil in millimetres, and what networks are told of it and the bench (conditions.rs).
struct Pupil {
    mm: f32,
    blur: f32,
    fresnel: f32,
}

// One of the frame's planes at the corners of block (x, y).
fn corners(plane: u32, x: u32, y: u32) -> vec4f {
    let first = plane * FRAME_WIDTH * FRAME_HEIGHT;
    return vec4f(
        frame[first + block_pixel(x, y, 0u)],
        frame[first + block_pixel(x, y, 1u)],
        frame[first + block_pixel(x, y, 2u)],
        frame[first + block_pixel(x, y, 3u)],
    );
}
