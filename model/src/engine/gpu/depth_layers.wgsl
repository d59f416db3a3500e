// The light of the depth layers, and how it goes to the SLM plane, as depth_layers.rs and expected_stack.rs have it.
//
// Before this file: fft.wgsl, pupil.wgsl, transfer_tables.wgsl and the constants of depth_layers.rs. What lights the
// layers is in light_of_layers.wgsl.

@group(0) @binding(3) var<storage, read_write> spectra: array<Stored>; // [layers, 3, height, width]
// Transfer functions from one layer to the next nearer one, and from the nearest to the SLM plane, the latter times
// UNITARY.
@group(0) @binding(4) var<storage, read> step_nearer: array<vec2f>;
@group(0) @binding(5) var<storage, read> back: array<vec2f>;
@group(0) @binding(6) var<storage, read> pupil_mm: f32;
// [3, height, width]: the spectrum of what arrives at the SLM plane.
@group(0) @binding(7) var<storage, read_write> carried_spectrum: array<Stored>;
@group(0) @binding(8) var<storage, read_write> arriving_rows: array<Stored>; // [3, height, width]

// Columns of one colour: from spectra along x of all layers' light to that, along x too, of what arrives of it at the
// SLM plane. Where STOPS, it has gone through the pupil.
@compute @workgroup_size(THREADS)
fn bring_back(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) index: u32) {
    thread = index;
    let colour = group.y;
    var steps: array<vec2f, ITEMS>;
    var next: array<Stored, ITEMS>;
    for (var item = 0u; item < ITEMS; item++) {
        let place = item * THREADS + thread;
        let x = group.x * LINES + place % LINES;
        if (place < PLACES && x < WIDTH) {
            steps[item] = step_nearer[table_place(colour, x, place / LINES)];
            next[item] = spectra[(colour * HEIGHT + place / LINES) * WIDTH + x];
        }
    }
    // Horner's rule, far to near. Each layer's light is asked for while the one before is transformed.
    var sums: array<vec2f, ITEMS>;
    for (var layer = 0u; layer < LAYERS; layer++) {
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let x = group.x * LINES + place % LINES;
            if (place < PLACES && x < WIDTH) {
                line[place] = loaded(next[item]);
                if (layer + 1u < LAYERS) {
                    next[item] = spectra[((3u * (layer + 1u) + colour) * HEIGHT + place / LINES) * WIDTH + x];
                }
            }
        }
        transform(FORWARD);
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            if (place < PLACES) {
                sums[item] = times(sums[item], steps[item]) + line[place];
            }
        }
    }
    for (var item = 0u; item < ITEMS; item++) {
        let place = item * THREADS + thread;
        let x = group.x * LINES + place % LINES;
        let y = place / LINES;
        if (place < PLACES && x < WIDTH) {
            var arriving = times(sums[item], back[table_place(colour, x, y)]);
            if (STOPS) {
                arriving = select(vec2f(), arriving, passes_pupil(x, y, colour, pupil_mm));
            } else {
                carried_spectrum[(colour * HEIGHT + y) * WIDTH + x] = stored(arriving);
            }
            line[place] = UNITARY * arriving;
        }
    }
    transform(INVERSE);
    for (var item = 0u; item < ITEMS; item++) {
        let place = item * THREADS + thread;
        let x = group.x * LINES + place % LINES;
        if (place < PLACES && x < WIDTH) {
            arriving_rows[(colour * HEIGHT + place / LINES) * WIDTH + x] = stored(line[place]);
        }
    }
}
