// Adds a batch of views to some planes' sums, one pixel of one plane for each invocation. The twin of the adding in
// thin_lens.rs.

struct Batch {
    width: u32,
    height: u32,
    // Of a view.
    columns: u32,
    rows: u32,
    // Views of this batch, the first of them among all points, and by what they are weighted.
    views: u32,
    first_point: u32,
    weight: f32,
    // Planes of the stack.
    planes: u32,
}

@group(0) @binding(0) var<uniform> batch: Batch;
// [views, 3, rows, columns].
@group(0) @binding(1) var<storage, read> colours: array<f32>;
// [points, planes]: the sample that lands in the picture's first pixel.
@group(0) @binding(2) var<storage, read> first_samples: array<u32>;
// The plane of the stack that comes first in `sums`.
@group(0) @binding(3) var<storage, read> first_plane: u32;
// [planes from there on, 3, height, width].
@group(0) @binding(4) var<storage, read_write> sums: array<f32>;

@compute @workgroup_size(16, 8)
fn add(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= batch.width || id.y >= batch.height {
        return;
    }
    let plane = first_plane + id.z;
    let pixels = batch.width * batch.height;
    let samples = batch.columns * batch.rows;
    let at = id.z * 3u * pixels + id.y * batch.width + id.x;
    var sum = vec3(sums[at], sums[at + pixels], sums[at + 2u * pixels]);
    for (var view = 0u; view < batch.views; view++) {
        let first = first_samples[(batch.first_point + view) * batch.planes + plane];
        let sample = view * 3u * samples + first + id.y * batch.columns + id.x;
        sum += batch.weight * vec3(colours[sample], colours[sample + samples], colours[sample + 2u * samples]);
    }
    sums[at] = sum.x;
    sums[at + pixels] = sum.y;
    sums[at + 2u * pixels] = sum.z;
}
