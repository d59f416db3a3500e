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
