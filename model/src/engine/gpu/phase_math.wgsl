// Angles to single precision, as phase_math.rs has them: WGSL asks of its own functions only 2^-11 of a turn.

const PI: f32 = 3.14159265358979;

// arg(re + j·im) in [-π, π], and 0 of 0: Abramowitz and Stegun's 4.4.49.
fn argument(value: vec2f) -> f32 {
    let size = abs(value);
    let steep = size.y > size.x;
    let tangent = select(size.y, size.x, steep) / max(select(size.x, size.y, steep), 1.17549435e-38);
    let z = tangent * tangent;
    var sum = 0.002866226;
    sum = fma(sum, z, -0.016165737);
    sum = fma(sum, z, 0.042909614);
    sum = fma(sum, z, -0.07528964);
    sum = fma(sum, z, 0.10656264);
    sum = fma(sum, z, -0.142089);
    sum = fma(sum, z, 0.19993551);
    sum = fma(sum, z, -0.33333145);
    var angle = fma(tangent * z, sum, tangent);
    angle = select(angle, 0.5 * PI - angle, steep);
    angle = select(angle, PI - angle, value.x < 0.0);
    return select(angle, -angle, value.y < 0.0);
}

// (cos, sin) of π·half_turns: Taylor's series within an eighth of a turn.
fn cos_sin_pi(half_turns: f32) -> vec2f {
    let quarters = round(2.0 * half_turns);
    let quarter = i32(quarters);
    let x = fma(-0.5, quarters, half_turns) * PI;
    let z = x * x;
    let sine = x + x * z * fma(z, fma(z, fma(z, 1.0 / 362880.0, -1.0 / 5040.0), 1.0 / 120.0), -1.0 / 6.0);
    let cosine = 1.0 + z * fma(z, fma(z, fma(z, 1.0 / 40320.0, -1.0 / 720.0), 1.0 / 24.0), -0.5);
    let turned = select(vec2f(cosine, sine), vec2f(-sine, cosine), (quarter & 1) == 1);
    return select(turned, -turned, (quarter & 2) == 2);
}
