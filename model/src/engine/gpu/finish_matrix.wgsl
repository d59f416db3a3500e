// What one thread does with matrices of sums in `finished`, of which it has one pixel and eight channels, from `group`
// on.

// Of matrix `matrix`.
fn finish(matrix: u32, skip: Skipped, group: u32, x: u32, y: u32) {
    let first = matrix * 64u + lane / 2u * 4u + lane % 2u * 2u;
    let low = finished[first] + vec4f(parameters[group]);
    let high = finished[first + 1u] + vec4f(parameters[group + 1u]);
    store(array(low, high), skip, group, x, y);
}
