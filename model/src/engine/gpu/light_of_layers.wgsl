// The light that the depth layers send out. Before this file: fft.wgsl, phase_math.wgsl, the constants of
// depth_layers.rs and what the map of the first net's outputs declares as `output`, in single precision.

// The first net's: for each layer a group of three phases over π and a mask, then the changes of the amplitudes.
@group(0) @binding(1) var<storage, read> outputs: array<output_vector>;
// [layers, 3, height, width]: the amplitudes that an eye should see, which are refined here.
@group(0) @binding(2) var<storage, read_write> stack: array<f32>;
@group(0) @binding(3) var<storage, read_write> spectra: array<vec2f>; // [layers, 3, height, width]

// Rows of the light that one layer sends out, to spectra along x.
@compute @workgroup_size(THREADS)
fn light(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) index: u32) {
    thread = index;
    let layer = group.y;
    var half_turns: array<vec3f, ITEMS>;
    var masks: array<f32, ITEMS>;
    for (var item = 0u; item < ITEMS; item++) {
        let place = item * THREADS + thread;
        let y = group.x * LINES + place % LINES;
        if (place < PLACES && y < HEIGHT) {
            let lit = outputs[output_place(layer, place / LINES, y)];
            half_turns[item] = lit.xyz;
            masks[item] = 1f / (1f + exp(MASK_OFFSET - lit.w));
        }
    }
    for (var colour = 0u; colour < 3u; colour++) {
        let channel = 3u * layer + colour;
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let x = place / LINES;
            let y = group.x * LINES + place % LINES;
            if (place < PLACES && y < HEIGHT) {
                var wanted = stack[(channel * HEIGHT + y) * WIDTH + x];
                if (REFINES) {
                    let change = outputs[output_place(LAYERS + channel / 4u, x, y)][channel % 4u];
                    wanted = max(wanted + REFINED_SHARE * change, 0f);
                    stack[(channel * HEIGHT + y) * WIDTH + x] = wanted;
                }
                line[place] = masks[item] * wanted * cos_sin_pi(half_turns[item][colour]);
            }
        }
        transform(FORWARD);
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let y = group.x * LINES + place % LINES;
            if (place < PLACES && y < HEIGHT) {
                spectra[(channel * HEIGHT + y) * WIDTH + place / LINES] = line[place];
            }
        }
    }
}
