// Winograd's F(4, 3) along columns: four sums of three products each by six products. Four rows of outputs are, like
// the coefficients of a product of polynomials, known from values at six points: 0, ±POINT_A, ±POINT_B and infinity.
// Needs Number, and Vector of four of them.

const POINTS = 6u;

// Six rows of inputs at the points.
fn at_points(rows: array<Vector, POINTS>) -> array<Vector, POINTS> {
    let a = Number(POINT_A);
    let b = Number(POINT_B);
    let minus_square_a = Vector(Number(-POINT_A * POINT_A));
    let minus_square_b = Vector(Number(-POINT_B * POINT_B));
    let minus_squares = Vector(Number(-POINT_A * POINT_A - POINT_B * POINT_B));
    let product_of_squares = Vector(Number(POINT_A * POINT_A * POINT_B * POINT_B));
    let odd_a = fma(minus_square_b, rows[1], rows[3]);
    let even_a = fma(minus_square_b, rows[2], rows[4]);
    let odd_b = fma(minus_square_a, rows[1], rows[3]);
    let even_b = fma(minus_square_a, rows[2], rows[4]);
    return array<Vector, POINTS>(
        fma(product_of_squares, rows[0], fma(minus_squares, rows[2], rows[4])),
        fma(Vector(a), odd_a, even_a),
        fma(Vector(-a), odd_a, even_a),
        fma(Vector(b), odd_b, even_b),
        fma(Vector(-b), odd_b, even_b),
        fma(product_of_squares, rows[1], fma(minus_squares, rows[3], rows[5])),
    );
}

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
