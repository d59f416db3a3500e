// The light that the depth layers send out. Before this file: fft.wgsl, phase_math.wgsl, expected.wgsl, the constants
// of depth_layers.rs and what the map of the first net's outputs declares as `output`.

// The first net's: for each layer a group of three phases over π and a mask, then the changes of the amplitudes.
@group(0) @binding(1) var<storage, read> outputs: array<output_vector>;
@group(0) @binding(2) var<storage, read> inputs: array<input_vector>;
@group(0) @binding(3) var<storage, read_write> spectra: array<Stored>; // [layers, 3, height, width]
// [layers, 3, height, width]: where they are refined, the amplitudes that an eye should see.
@group(0) @binding(4) var<storage, read_write> stack: array<Amplitude>;

// Rows of the light that LAYERS_TOGETHER layers send out, to spectra along x.
@compute @workgroup_size(THREADS)
fn light(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) index: u32) {
    thread = index;
    for (var slot = 0u; slot < LAYERS_TOGETHER; slot++) {
        let layer = LAYERS_TOGETHER * group.y + slot;
        var half_turns: array<vec3f, ITEMS>;
        var masks: array<f32, ITEMS>;
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let y = group.x * LINES + place % LINES;
            if (place < PLACES && y < HEIGHT) {
                let lit = vec4f(outputs[output_place(layer, place / LINES, y)]);
                half_turns[item] = lit.xyz;
                masks[item] = UNITARY / (1f + exp(MASK_OFFSET - lit.w));
            }
        }
        for (var colour = 0u; colour < 3u; colour++) {
            let channel = 3u * layer + colour;
            for (var item = 0u; item < ITEMS; item++) {
                let place = item * THREADS + thread;
                let x = place / LINES;
                let y = group.x * LINES + place % LINES;
                if (place < PLACES && y < HEIGHT) {
                    var wanted = expected(channel, x, y);
                    if (REFINES) {
                        let change = f32(outputs[output_place(LAYERS + channel / 4u, x, y)][channel % 4u]);
                        wanted = max(wanted + REFINED_SHARE * change, 0f);
                        stack[(channel * HEIGHT + y) * WIDTH + x] = Amplitude(wanted);
                    }
                    line[place] = masks[item] * wanted * cos_sin_pi(half_turns[item][colour]);
                }
            }
            transform(FORWARD);
            for (var item = 0u; item < ITEMS; item++) {
                let place = item * THREADS + thread;
                let y = group.x * LINES + place % LINES;
                if (place < PLACES && y < HEIGHT) {
                    spectra[(channel * HEIGHT + y) * WIDTH + place / LINES] = stored(line[place]);
                }
            }
        }
    }
}
