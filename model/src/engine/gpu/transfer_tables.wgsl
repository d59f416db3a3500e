// Tables of transfer functions, [3, height/2 + 1, width/2 + 1]: they are the same for a frequency and its opposite.
// Before this file: WIDTH and HEIGHT.

// Where a table has bin (x, y) of `colour`.
fn table_place(colour: u32, x: u32, y: u32) -> u32 {
    let column = min(x, WIDTH - x);
    let row = min(y, HEIGHT - y);
    return (colour * (HEIGHT / 2u + 1u) + row) * (WIDTH / 2u + 1u) + column;
}
