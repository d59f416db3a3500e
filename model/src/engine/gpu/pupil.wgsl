// The eye's pupil in the Fourier plane of the network's grid: a disc of radius (s/2)/(λ·f). Before this file: fft.wgsl,
// WIDTH, HEIGHT and, of each colour, the radius in cycles a sample to a millimetre of pupil.

// Whether bin (kx, ky) of the spectrum of `colour` goes through a pupil of `pupil_mm`.
fn passes_pupil(kx: u32, ky: u32, colour: u32, pupil_mm: f32) -> bool {
    let f = vec2f(frequency(kx, WIDTH), frequency(ky, HEIGHT));
    let radius = vec3f(RADIUS_PER_MM_RED, RADIUS_PER_MM_GREEN, RADIUS_PER_MM_BLUE)[colour] * pupil_mm;
    return dot(f, f) < radius * radius;
}
