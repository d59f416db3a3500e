// What an eye should see at each depth layer, as defocus.rs computes it: every layer's light is blurred by its disc of
// confusion at the focus on each other one, and the sum is divided by that of a white scene.
//
// Before this file: fft.wgsl, blocks.wgsl, input_features.wgsl and the constants of defocus.rs.

const PIXELS = WIDTH * HEIGHT;

@group(0) @binding(1) var<storage, read> frame: array<f32>; // [4, frame height, frame width]
@group(0) @binding(2) var<storage, read> pupil: Pupil;
// The depth layers of each block's corners, a byte each, [height, width].
@group(0) @binding(3) var<storage, read_write> layer_of: array<u32>;
// Of each layer and pair, [layers, PAIRS, height, width]; what is seen at each focus follows from plane FIRST_SEEN on.
@group(0) @binding(4) var<storage, read_write> spectra: array<vec2f>;
@group(0) @binding(5) var<storage, read> disc_table: array<f32>;
@group(0) @binding(6) var<storage, read_write> stack: array<f32>; // [layers, 3, height, width]
@group(0) @binding(7) var<storage, read_write> inputs: array<input_vector>;

fn depth_layer(depth: f32) -> u32 {
    let layer = depth * f32(LAYERS);
    return u32(min(select(0f, layer, layer > 0f), f32(LAYERS - 1u)));
}

// Rows of each layer's light, to spectra along x. A workgroup reads its rows of the frame once, and also writes what
// the map has of them.
@compute @workgroup_size(THREADS)
fn take_layers(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) index: u32) {
    thread = index;
    var layers: array<u32, ITEMS>;
    // Intensities of red, green and blue at the corners.
    var light: array<array<vec4f, 3>, ITEMS>;
    for (var item = 0u; item < ITEMS; item++) {
        let place = item * THREADS + thread;
        let x = place / LINES;
        let y = group.x * LINES + place % LINES;
        if (place < PLACES && y < HEIGHT) {
            let depths = corners(3u, x, y);
            inputs[input_place(3u, x, y)] = input_vector(2f * (depths - 0.5f));
            inputs[input_place(4u, x, y)] = input_vector((depths - 0.5f) * (3f + 2f * pupil.blur));
            for (var corner = 0u; corner < BLOCK; corner++) {
                layers[item] |= depth_layer(depths[corner]) << (8u * corner);
            }
            layer_of[y * WIDTH + x] = layers[item];
            for (var colour = 0u; colour < 3u; colour++) {
                let amplitudes = corners(colour, x, y);
                inputs[input_place(colour, x, y)] = input_vector(amplitudes - 0.4f);
                light[item][colour] = amplitudes * amplitudes;
            }
        }
    }
    for (var plane = 0u; plane < PAIRS * LAYERS; plane++) {
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            if (place < PLACES) {
                // What is elsewhere may be no number, which no product would remove.
                var white_red = vec2f();
                var green_blue = vec2f();
                for (var corner = 0u; corner < BLOCK; corner++) {
                    if ((layers[item] >> (8u * corner) & 0xffu) == plane / PAIRS) {
                        white_red += vec2f(1f, light[item][0][corner]);
                        green_blue += vec2f(light[item][1][corner], light[item][2][corner]);
                    }
                }
                line[place] = select(white_red, green_blue, plane % PAIRS == 1u) / f32(BLOCK);
            }
        }
        transform(FORWARD);
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let y = group.x * LINES + place % LINES;
            if (place < PLACES && y < HEIGHT) {
                spectra[(plane * HEIGHT + y) * WIDTH + place / LINES] = line[place];
            }
        }
    }
}

// The spectrum of a disc, 2·J1(x)/x, at x·DENSITY = entry.
fn disc(entry: f32) -> f32 {
    if (entry >= f32(DISC_ENTRIES - 1u)) {
        return 0f;
    }
    let below = u32(entry);
    return mix(disc_table[below], disc_table[below + 1u], fract(entry));
}

// Columns of one pair: from spectra along x of all layers to those, along x too, of what is seen at the focus on FOCI
// of them.
@compute @workgroup_size(THREADS)
fn blur(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) index: u32) {
    thread = index;
    let pair = group.y;
    let first_focus = group.z * FOCI;
    let entries_apart = ENTRIES_PER_MM * pupil.mm;
    var seen: array<array<vec2f, FOCI>, ITEMS>;
    // Each layer's light is asked for while the one before is transformed.
    var next: array<vec2f, ITEMS>;
    for (var turn_of = 0u; turn_of <= LAYERS; turn_of++) {
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let x = group.x * LINES + place % LINES;
            if (place < PLACES && x < WIDTH) {
                line[place] = next[item];
                if (turn_of < LAYERS) {
                    next[item] = spectra[((turn_of * PAIRS + pair) * HEIGHT + place / LINES) * WIDTH + x];
                }
            }
        }
        if (turn_of == 0u) {
            continue;
        }
        let layer = turn_of - 1u;
        transform(FORWARD);
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            if (place < PLACES) {
                let x = group.x * LINES + place % LINES;
                let f = vec2f(frequency(x, WIDTH), frequency(place / LINES, HEIGHT));
                let entry = entries_apart * length(f);
                for (var focus = 0u; focus < FOCI; focus++) {
                    let apart = abs(f32(layer) - f32(first_focus + focus));
                    seen[item][focus] += disc(apart * entry) * line[place];
                }
            }
        }
    }
    for (var focus = 0u; focus < FOCI && first_focus + focus < LAYERS; focus++) {
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            if (place < PLACES) {
                // A register is chosen by comparing: memory is what has addresses.
                var chosen = vec2f();
                for (var candidate = 0u; candidate < FOCI; candidate++) {
                    chosen = select(chosen, seen[item][candidate], candidate == focus);
                }
                line[place] = chosen / f32(PIXELS);
            }
        }
        transform(INVERSE);
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let x = group.x * LINES + place % LINES;
            if (place < PLACES && x < WIDTH) {
                let plane = FIRST_SEEN + (first_focus + focus) * PAIRS + pair;
                spectra[(plane * HEIGHT + place / LINES) * WIDTH + x] = line[place];
            }
        }
    }
}

// Of one pair of what is seen at a focus, along x, what is at `item` of the rows of a workgroup; nothing of pairs that
// follow the last one.
fn seen_spectrum(focus_pair: u32, rows: u32, item: u32) -> vec2f {
    let place = item * THREADS + thread;
    let y = rows * LINES + place % LINES;
    if (place < PLACES && y < HEIGHT && focus_pair < LAYERS * PAIRS) {
        return spectra[((FIRST_SEEN + focus_pair) * HEIGHT + y) * WIDTH + place / LINES];
    }
    return vec2f();
}

// Rows of what is seen at the foci 4·b - 2 to 4·b + 1 of workgroup b along y: to the stack, and to the twelve channels
// from 12·b + 16 on of the map. The first workgroup has only the last two foci, whose channels share a group with blur
// and diffraction.
@compute @workgroup_size(THREADS)
fn see(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) index: u32) {
    thread = index;
    var shown: array<array<vec3f, 4>, ITEMS>;
    // Each pair's spectra are asked for while those before are transformed.
    var next: array<vec2f, ITEMS>;
    for (var item = 0u; item < ITEMS; item++) {
        next[item] = seen_spectrum(select(4u * group.y - 2u, 0u, group.y == 0u) * PAIRS, group.x, item);
    }
    for (var slot = 0u; slot < 4u; slot++) {
        let focus = 4u * group.y + slot - 2u;
        if (focus < LAYERS) {
            var white_red: array<vec2f, ITEMS>;
            for (var pair = 0u; pair < PAIRS; pair++) {
                for (var item = 0u; item < ITEMS; item++) {
                    let place = item * THREADS + thread;
                    if (place < PLACES) {
                        // What the pair before has left, the second time round.
                        white_red[item] = line[place];
                        line[place] = next[item];
                        next[item] = seen_spectrum(focus * PAIRS + pair + 1u, group.x, item);
                    }
                }
                transform(INVERSE);
            }
            for (var item = 0u; item < ITEMS; item++) {
                let place = item * THREADS + thread;
                let x = place / LINES;
                let y = group.x * LINES + place % LINES;
                if (place < PLACES && y < HEIGHT) {
                    let light = vec3f(white_red[item].y, line[place]) / max(white_red[item].x, LEAST_COVER);
                    let amplitudes = sqrt(max(light, vec3f()));
                    for (var colour = 0u; colour < 3u; colour++) {
                        stack[((3u * focus + colour) * HEIGHT + y) * WIDTH + x] = amplitudes[colour];
                    }
                    for (var candidate = 0u; candidate < 4u; candidate++) {
                        shown[item][candidate] = select(shown[item][candidate], amplitudes - 0.4f, candidate == slot);
                    }
                }
            }
        }
    }
    for (var item = 0u; item < ITEMS; item++) {
        let place = item * THREADS + thread;
        let x = place / LINES;
        let y = group.x * LINES + place % LINES;
        if (place < PLACES && y < HEIGHT) {
            let a = shown[item][0];
            let b = shown[item][1];
            let c = shown[item][2];
            let d = shown[item][3];
            let told = vec2f(pupil.blur, pupil.fresnel);
            let channels = array(vec4f(a, b.x), vec4f(select(b.yz, told, group.y == 0u), c.xy), vec4f(c.z, d));
            for (var part = 0u; part < 3u; part++) {
                let map_group = 3u * group.y + 4u + part;
                if (map_group < FIRST_PART_GROUPS && (part > 0u || group.y > 0u)) {
                    inputs[input_place(map_group, x, y)] = input_vector(channels[part]);
                }
            }
        }
    }
}
