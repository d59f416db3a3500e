// What winograd.wgsl leaves to be done. Needs store.wgsl.

// Stores four rows of one group of channels, from their sums at the points.
fn store_rows(sums: array<vec4f, POINTS>, bias: vec4f, group: u32, x: u32, y: u32) {
    let even_a = sums[1] + sums[2];
    let even_b = sums[3] + sums[4];
    let odd_a = POINT_A * (sums[1] - sums[2]);
    let odd_b = POINT_B * (sums[3] - sums[4]);
    store(bias + sums[0] + even_a + even_b, group, x, y);
    store(bias + odd_a + odd_b, group, x, y + 1u);
    store(bias + POINT_A * POINT_A * even_a + POINT_B * POINT_B * even_b, group, x, y + 2u);
    store(bias + POINT_A * POINT_A * odd_a + POINT_B * POINT_B * odd_b + sums[5], group, x, y + 3u);
}
