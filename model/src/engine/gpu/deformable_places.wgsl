// Where a deformable convolution reads its map; twin of `sample` in ../cpu/deformable.rs.

// (dy, dx) of the nine taps, two to a group of channels.
@group(0) @binding(1) var<storage, read> offsets: array<vec2f>;

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
    return Place(first.y * (IN_GROUPS * IN_PITCH) + first.x * IN_BLOCK, shares);
}

