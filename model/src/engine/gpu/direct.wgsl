// What the `direct` family's net reads, and the field that it gives. After these constants:
// WORKGROUP (pixels of a row), FRAME_WIDTH, FRAME_HEIGHT, WIDTH, HEIGHT (of the network's grid), SCALE (panel pixels to
// a sample, each way), what the map declares of itself, and how buffers hold complex numbers.

// The eye's pupil in millimetres, and what networks are told of it and the bench (conditions.rs).
struct Pupil {
    mm: f32,
    blur: f32,
    fresnel: f32,
}

@group(0) @binding(0) var<storage, read> frame: array<f32>; // [4, frame height, frame width]
@group(0) @binding(1) var<storage, read> pupil: Pupil;
@group(0) @binding(2) var<storage, read_write> map: array<map_vector>;
@group(0) @binding(3) var<storage, read_write> low: array<Stored>; // [3, height, width]

const BLOCK: u32 = SCALE * SCALE;

// A plane of the frame at a corner of block (x, y), counted along rows; one of odd size repeats its edge.
fn at(plane: u32, x: u32, y: u32, corner: u32) -> f32 {
    let row = min(SCALE * y + corner / SCALE, FRAME_HEIGHT - 1u);
    let column = min(SCALE * x + corner % SCALE, FRAME_WIDTH - 1u);
    return frame[(plane * FRAME_HEIGHT + row) * FRAME_WIDTH + column];
}

fn channel(index: u32, x: u32, y: u32) -> f32 {
    let plane = index / BLOCK;
    let corner = index % BLOCK;
    if plane < 3u {
        return at(plane, x, y, corner);
    }
    if plane == 3u {
        return at(3u, x, y, corner) - 0.5;
    }
    if plane == 4u {
        return (3.0 + 2.0 * pupil.blur) * (at(3u, x, y, corner) - 0.5);
    }
    if index == 5u * BLOCK {
        return pupil.blur;
    }
    return select(0.0, pupil.fresnel, index == 5u * BLOCK + 1u);
}

@compute @workgroup_size(WORKGROUP)
fn encode(@builtin(global_invocation_id) place: vec3u) {
    let x = place.x;
    let y = place.y;
    let group = place.z;
    if x >= WIDTH {
        return;
    }
    var values: vec4f;
    for (var part = 0u; part < 4u; part++) {
        values[part] = channel(4u * group + part, x, y);
    }
    map[map_place(group, x, y)] = map_vector(values);
}

// The mean amplitude of each block, and what the net adds to it: three real parts and three imaginary ones.
@compute @workgroup_size(WORKGROUP)
fn add_residual(@builtin(global_invocation_id) place: vec3u) {
    let x = place.x;
    let y = place.y;
    if x >= WIDTH {
        return;
    }
    let reals = vec4f(map[map_place(0u, x, y)]);
    let rest = vec4f(map[map_place(1u, x, y)]);
    let residual = array<vec2f, 3>(vec2f(reals.x, reals.w), vec2f(reals.y, rest.x), vec2f(reals.z, rest.y));
    for (var colour = 0u; colour < 3u; colour++) {
        var sum = 0.0;
        for (var corner = 0u; corner < BLOCK; corner++) {
            sum += at(colour, x, y, corner);
        }
        low[(colour * HEIGHT + y) * WIDTH + x] = stored(vec2f(sum / f32(BLOCK), 0.0) + residual[colour]);
    }
}
