//! A stroke font of capitals and digits, drawn on a 4 x 6 grid (y down), for text on scene surfaces.

/// Distance from (x, y) to the strokes of `letter`, all in grid units (a letter is 4 wide and 6 high); infinite for a
/// blank.
pub(super) fn stroke_distance(letter: u8, x: f32, y: f32) -> f32 {
    let mut nearest = f32::INFINITY;
    for polyline in strokes(letter).split(' ').filter(|line| !line.is_empty()) {
        let points = polyline.as_bytes();
        for pair in 0..(points.len() / 2).saturating_sub(1) {
            let at = |k: usize| (f32::from(points[k] - b'0'), f32::from(points[k + 1] - b'0'));
            nearest = nearest.min(segment_distance_squared(x, y, at(2 * pair), at(2 * pair + 2)));
        }
    }
    nearest.sqrt()
}

fn segment_distance_squared(x: f32, y: f32, from: (f32, f32), to: (f32, f32)) -> f32 {
    let (dx, dy) = (to.0 - from.0, to.1 - from.1);
    let along = (((x - from.0) * dx + (y - from.1) * dy) / (dx * dx + dy * dy)).clamp(0.0, 1.0);
    let (ex, ey) = (x - from.0 - along * dx, y - from.1 - along * dy);
    ex * ex + ey * ey
}

/// Polylines separated by blanks; each pair of digits is a point x, y.
fn strokes(letter: u8) -> &'static str {
    match letter {
        b'A' => "062046 1434",
        b'B' => "0006 003041423303 3344453606",
        b'C' => "4130100105163645",
        b'D' => "000636454130 0030",
        b'E' => "40000646 0333",
        b'F' => "400006 0333",
        b'G' => "413010010516364543 2343",
        b'H' => "0006 4046 0343",
        b'I' => "2026 1030 1636",
        b'J' => "4045361605",
        b'K' => "0006 4003 1246",
        b'L' => "000646",
        b'M' => "0600234046",
        b'N' => "06004640",
        b'O' => "103041453616050110",
        b'P' => "060030413203 1303",
        b'Q' => "103041453616050110 2446",
        b'R' => "060030413203 2346",
        b'S' => "41301001123345361605",
        b'T' => "0040 2026",
        b'U' => "000516364540",
        b'V' => "002640",
        b'W' => "0016233640",
        b'X' => "0046 4006",
        b'Y' => "002340 2326",
        b'Z' => "00400646",
        b'0' => "103041453616050110 0541",
        b'1' => "112026 1636",
        b'2' => "011030410646",
        b'3' => "00402344361605",
        b'4' => "36300444",
        b'5' => "400003334536161605",
        b'6' => "40100105163645331303",
        b'7' => "004016",
        b'8' => "1030413212011030 324445361605041232",
        b'9' => "433313011030414526",
        b'.' => "2526",
        b'-' => "1333",
        b'/' => "0640",
        _ => "",
    }
}
