// Draws views of a scene, one ray for each invocation: sample (x, y) of view z. The twin of view.rs, with a bounding
// volume hierarchy in the place of triangles drawn one by one.

struct Frame {
    // Where the first sample is, in pixels from the middle of the picture, before the view's own offset.
    left: f32,
    top: f32,
    // Dioptres at which the rays pass the grid.
    grid_depth: f32,
    columns: u32,
    rows: u32,
    // The first view of this batch among all points.
    first_point: u32,
    surfaces: u32,
    nodes: u32,
}

// An aperture point in pixels per dioptre, and the grid's offset in a pixel.
struct ViewPoint {
    ax: f32,
    ay: f32,
    dx: f32,
    dy: f32,
}

const PLANE = 0u;
const ELLIPSOID = 1u;

struct Surface {
    // PLANE, ELLIPSOID, or neither: a mesh, whose triangles name it.
    kind: u32,
    columns: i32,
    rows: i32,
    first_texel: u32,
    left: f32,
    top: f32,
    cx: f32,
    cy: f32,
    depth: f32,
    // A plane's gradients, or an ellipsoid's radii.
    gx_rx: f32,
    gy_ry: f32,
    rd: f32,
}

struct Vertex {
    x: f32,
    y: f32,
    depth: f32,
    u: f32,
    v: f32,
}

struct Triangle {
    a: Vertex,
    b: Vertex,
    c: Vertex,
    surface: u32,
}

// A box around triangles, or around two nodes: `first` and the one after it.
struct Node {
    left: f32,
    right: f32,
    top: f32,
    bottom: f32,
    far: f32,
    near: f32,
    first: u32,
    // 0: the box holds nodes.
    triangles: u32,
}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> points: array<ViewPoint>;
@group(0) @binding(2) var<storage, read> surfaces: array<Surface>;
@group(0) @binding(3) var<storage, read> texels: array<vec2<u32>>;
@group(0) @binding(4) var<storage, read> nodes: array<Node>;
@group(0) @binding(5) var<storage, read> triangles: array<Triangle>;
// [views, 3, rows, columns].
@group(0) @binding(6) var<storage, read_write> colours: array<f32>;

const TEXELS_PER_PIXEL = 2.0;
const OPAQUE = 0.5;
// As deep as the hierarchy can be.
const STACK = 32u;
// Boxes are grown by this many pixels, for rounding.
const SLACK = 0.01;
const NOTHING = -1e30;

struct Hit {
    depth: f32,
    colour: vec3<f32>,
}

// Takes what a surface has at (u, v) of its texture, if it is not cut away there.
fn look(hit: ptr<function, Hit>, which: u32, depth: f32, x: f32, y: f32) {
    let surface = &surfaces[which];
    let u = (x - (*surface).left) * TEXELS_PER_PIXEL;
    let v = (y - (*surface).top) * TEXELS_PER_PIXEL;
    if u < 0.0 || v < 0.0 || u >= f32((*surface).columns) || v >= f32((*surface).rows) {
        return;
    }
    let packed = texels[(*surface).first_texel + u32(i32(v) * (*surface).columns + i32(u))];
    let blue_and_cover = unpack2x16float(packed.y);
    if blue_and_cover.y >= OPAQUE {
        (*hit).depth = depth;
        (*hit).colour = vec3(unpack2x16float(packed.x), blue_and_cover.x);
    }
}

// Where the view shows a corner.
fn projected(corner: Vertex, point: ViewPoint) -> vec2<f32> {
    let lift = corner.depth - frame.grid_depth;
    return vec2(corner.x - point.ax * lift, corner.y - point.ay * lift);
}

fn meet(hit: ptr<function, Hit>, which: u32, point: ViewPoint, x: f32, y: f32) {
    let triangle = triangles[which];
    let a = projected(triangle.a, point);
    let b = projected(triangle.b, point);
    let c = projected(triangle.c, point);
    let twice_area = (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x);
    if twice_area == 0.0 {
        return;
    }
    let share = 1.0 / twice_area;
    let at_b = ((x - a.x) * (c.y - a.y) - (y - a.y) * (c.x - a.x)) * share;
    let at_c = ((b.x - a.x) * (y - a.y) - (b.y - a.y) * (x - a.x)) * share;
    let at_a = 1.0 - at_b - at_c;
    if at_a < 0.0 || at_b < 0.0 || at_c < 0.0 {
        return;
    }
    let depth = triangle.a.depth * at_a + triangle.b.depth * at_b + triangle.c.depth * at_c;
    if depth > (*hit).depth {
        let u = triangle.a.u * at_a + triangle.b.u * at_b + triangle.c.u * at_c;
        let v = triangle.a.v * at_a + triangle.b.v * at_b + triangle.c.v * at_c;
        look(hit, triangle.surface, depth, u, v);
    }
}

@compute @workgroup_size(16, 8)
fn draw(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= frame.columns || id.y >= frame.rows {
        return;
    }
    let point = points[frame.first_point + id.z];
    let x = frame.left + point.dx + f32(id.x);
    let y = frame.top + point.dy + f32(id.y);
    // The ray at infinity.
    let x0 = x - point.ax * frame.grid_depth;
    let y0 = y - point.ay * frame.grid_depth;
    var hit = Hit(NOTHING, vec3(0.0));

    for (var which = 0u; which < frame.surfaces; which++) {
        let surface = &surfaces[which];
        let flat_depth = (*surface).depth;
        let gx_rx = (*surface).gx_rx;
        let gy_ry = (*surface).gy_ry;
        var depth = NOTHING;
        if (*surface).kind == PLANE {
            let share = 1.0 / (1.0 - gx_rx * point.ax - gy_ry * point.ay);
            depth = (flat_depth + gx_rx * (x0 - (*surface).cx) + gy_ry * (y0 - (*surface).cy)) * share;
        } else if (*surface).kind == ELLIPSOID {
            let rd = (*surface).rd;
            let px = (x0 + point.ax * flat_depth - (*surface).cx) / gx_rx;
            let py = (y0 + point.ay * flat_depth - (*surface).cy) / gy_ry;
            let qx = point.ax / gx_rx;
            let qy = point.ay / gy_ry;
            let a = qx * qx + qy * qy + 1.0 / (rd * rd);
            let b = px * qx + py * qy;
            let discriminant = b * b - a * (px * px + py * py - 1.0);
            if discriminant >= 0.0 {
                depth = flat_depth + (sqrt(discriminant) - b) / a;
            }
        }
        if depth > hit.depth {
            look(&hit, which, depth, x0 + point.ax * depth, y0 + point.ay * depth);
        }
    }

    if frame.nodes > 0u {
        var waiting: array<u32, STACK>;
        var count = 1u;
        waiting[0] = 0u;
        while count > 0u {
            count--;
            let node = nodes[waiting[count]];
            // Where the ray enters and leaves the box's range of depth.
            let far_x = x0 + point.ax * node.far;
            let near_x = x0 + point.ax * node.near;
            let far_y = y0 + point.ay * node.far;
            let near_y = y0 + point.ay * node.near;
            if node.near <= hit.depth || max(far_x, near_x) < node.left - SLACK || min(far_x, near_x) > node.right + SLACK
                || max(far_y, near_y) < node.top - SLACK || min(far_y, near_y) > node.bottom + SLACK {
                continue;
            }
            if node.triangles == 0u {
                waiting[count] = node.first;
                waiting[count + 1u] = node.first + 1u;
                count += 2u;
                continue;
            }
            for (var which = node.first; which < node.first + node.triangles; which++) {
                meet(&hit, which, point, x, y);
            }
        }
    }

    let samples = frame.columns * frame.rows;
    let at = id.z * 3u * samples + id.y * frame.columns + id.x;
    colours[at] = hit.colour.x;
    colours[at + samples] = hit.colour.y;
    colours[at + 2u * samples] = hit.colour.z;
}
