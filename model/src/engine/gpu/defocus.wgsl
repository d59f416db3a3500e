// What an eye should see at each depth layer, as defocus.rs computes it: every layer's light is blurred by its disc of
// confusion at the focus on each other one, and the sum is divided by that of a white scene.
//
// Before this file: fft.wgsl, blocks.wgsl, input_features.wgsl, the constants of defocus.rs, among them LAYER_SHIFTS,
// and what the nets' map declares as `input`.

@group(0) @binding(1) var<storage, read> frame: array<f32>; // [4, frame height, frame width]
@group(0) @binding(2) var<storage, read> pupil: Pupil;
// The depth layers of each block's corners, a byte each, [height, width].
@group(0) @binding(3) var<storage, read_write> layer_of: array<u32>;
// Of each layer and pair, [layers, PAIRS, height, width]; what is seen at each focus follows from plane FIRST_SEEN on.
@group(0) @binding(4) var<storage, read_write> spectra: array<Stored>;
@group(0) @binding(5) var<storage, read> disc_table: array<f32>;
@group(0) @binding(6) var<storage, read_write> inputs: array<input_vector>;

// The first of the map's groups, from those of the stack on, that hold nothing of it.
const TOLD_GROUP = (3u * LAYERS + 3u) / 4u;

// The layers of a block's corners, a byte each.
fn depth_layers(depths: vec4f) -> u32 {
    var layers = 0u;
    for (var corner = 0u; corner < BLOCK; corner++) {
        layers |= depth_layer(depths[corner], LAYER_SHIFTS[corner]) << (8u * corner);
    }
    return layers;
}

fn depth_layer(depth: f32, shift: f32) -> u32 {
    let layer = depth * f32(LAYERS) + shift;
    return u32(min(select(0f, layer, layer > 0f), f32(LAYERS - 1u)));
}

// What the map says of bench and pupil in channel `channel` from those of the stack on; elsewhere nothing.
fn told_channel(channel: u32) -> f32 {
    return select(select(0f, pupil.fresnel, channel == 3u * LAYERS + 1u), pupil.blur, channel == 3u * LAYERS);
}

fn told_group(group: u32) -> vec4f {
    return vec4f(
        told_channel(4u * group),
        told_channel(4u * group + 1u),
        told_channel(4u * group + 2u),
        told_channel(4u * group + 3u),
    );
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
            layers[item] = depth_layers(depths);
            layer_of[y * WIDTH + x] = layers[item];
            for (var colour = 0u; colour < 3u; colour++) {
                let amplitudes = corners(colour, x, y);
                inputs[input_place(colour, x, y)] = input_vector(amplitudes - 0.4f);
                light[item][colour] = amplitudes * amplitudes;
            }
            // What is told may need a group that holds nothing of the stack.
            if (4u * TOLD_GROUP < 3u * LAYERS + 2u) {
                inputs[input_place(STACK_GROUP + TOLD_GROUP, x, y)] = input_vector(told_group(TOLD_GROUP));
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
                line[place] = UNITARY / f32(BLOCK) * select(white_red, green_blue, plane % PAIRS == 1u);
            }
        }
        transform(FORWARD);
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let y = group.x * LINES + place % LINES;
            if (place < PLACES && y < HEIGHT) {
                spectra[(plane * HEIGHT + y) * WIDTH + place / LINES] = stored(line[place]);
            }
        }
    }
}

// The spectrum of a disc, 2·J1(x)/x, of layers that are `apart` layers apart, at `place` of the columns of workgroup
// `columns`.
fn disc(apart: f32, columns: u32, place: u32) -> f32 {
    const LAST = DISC_ENTRIES - 1u;
    let f = vec2f(frequency(columns * LINES + place % LINES, WIDTH), frequency(place / LINES, HEIGHT));
    let entry = apart * ENTRIES_PER_MM * pupil.mm * length(f);
    let below = min(u32(entry), LAST - 1u);
    return select(mix(disc_table[below], disc_table[below + 1u], fract(entry)), 0f, entry >= f32(LAST));
}

// A disc's spectrum is the same at a frequency along y and at its opposite: a thread takes both bins.
const BIN_PAIRS = (HEIGHT / 2u + 1u) * LINES;
const BIN_PAIR_ITEMS = (BIN_PAIRS + THREADS - 1u) / THREADS;

// The place of the bin opposite to that at `place`.
fn opposite(place: u32) -> u32 {
    return (HEIGHT - place / LINES) % HEIGHT * LINES + place % LINES;
}

// Of one pair of a layer's light, along x, what is at `item` of the columns of workgroup `columns`; nothing of pairs
// that follow the last one.
fn light_spectrum(layer_pair: u32, columns: u32, item: u32) -> Stored {
    let place = item * THREADS + thread;
    let x = columns * LINES + place % LINES;
    if (place < PLACES && x < WIDTH && layer_pair < LAYERS * PAIRS) {
        return spectra[(layer_pair * HEIGHT + place / LINES) * WIDTH + x];
    }
    return Stored();
}

// Columns of one pair: from spectra along x of all layers to those, along x too, of what is seen at the focus on FOCI
// of them.
@compute @workgroup_size(THREADS)
fn blur(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) index: u32) {
    thread = index;
    let pair = group.y;
    let first_focus = group.z * FOCI;
    // The disc of the present layer at each focus: that of the next one is the same at the next focus.
    var discs: array<array<f32, FOCI>, BIN_PAIR_ITEMS>;
    for (var item = 0u; item < BIN_PAIR_ITEMS; item++) {
        for (var focus = 0u; focus < FOCI; focus++) {
            discs[item][focus] = disc(f32(first_focus + focus), group.x, item * THREADS + thread);
        }
    }
    // Where there are registers for it, each layer's light is asked for while the one before is transformed.
    var next: array<Stored, ITEMS>;
    if (ASKS_EARLY) {
        for (var item = 0u; item < ITEMS; item++) {
            next[item] = light_spectrum(pair, group.x, item);
        }
    }
    var seen: array<array<vec4f, FOCI>, BIN_PAIR_ITEMS>;
    for (var layer = 0u; layer < LAYERS; layer++) {
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            if (place < PLACES) {
                if (ASKS_EARLY) {
                    line[place] = loaded(next[item]);
                    next[item] = light_spectrum((layer + 1u) * PAIRS + pair, group.x, item);
                } else {
                    line[place] = loaded(light_spectrum(layer * PAIRS + pair, group.x, item));
                }
            }
        }
        transform(FORWARD);
        // Others' places are read: chirps end with a thread's own.
        if (BLUESTEIN) {
            workgroupBarrier();
        }
        let apart = abs(f32(layer + 1u) - f32(first_focus));
        for (var item = 0u; item < BIN_PAIR_ITEMS; item++) {
            let place = item * THREADS + thread;
            if (place < BIN_PAIRS) {
                let light = vec4f(line[place], line[opposite(place)]);
                var next_disc = disc(apart, group.x, place);
                for (var focus = 0u; focus < FOCI; focus++) {
                    let present = discs[item][focus];
                    seen[item][focus] += present * light;
                    discs[item][focus] = next_disc;
                    next_disc = present;
                }
            }
        }
        workgroupBarrier();
    }
    for (var focus = 0u; focus < FOCI; focus++) {
        if (LAYERS % FOCI > 0u && first_focus + focus >= LAYERS) {
            break;
        }
        for (var item = 0u; item < BIN_PAIR_ITEMS; item++) {
            let place = item * THREADS + thread;
            if (place < BIN_PAIRS) {
                // A register is chosen by comparing: memory is what has addresses.
                var chosen = vec4f();
                for (var candidate = 0u; candidate < FOCI; candidate++) {
                    chosen = select(chosen, seen[item][candidate], candidate == focus);
                }
                line[place] = chosen.xy / f32(HEIGHT);
                line[opposite(place)] = chosen.zw / f32(HEIGHT);
            }
        }
        workgroupBarrier();
        transform(INVERSE);
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let x = group.x * LINES + place % LINES;
            if (place < PLACES && x < WIDTH) {
                let plane = FIRST_SEEN + (first_focus + focus) * PAIRS + pair;
                spectra[(plane * HEIGHT + place / LINES) * WIDTH + x] = stored(line[place]);
            }
        }
        workgroupBarrier();
    }
}

// Of one pair of what is seen at a focus, along x, what is at `item` of the rows of workgroup `rows`; nothing of pairs
// from `end` on.
fn seen_spectrum(focus_pair: u32, end: u32, rows: u32, item: u32) -> Stored {
    let place = item * THREADS + thread;
    let y = rows * LINES + place % LINES;
    if (place < PLACES && y < HEIGHT && focus_pair < end) {
        return spectra[((FIRST_SEEN + focus_pair) * HEIGHT + y) * WIDTH + place / LINES];
    }
    return Stored();
}

// Rows of what is seen at LAYERS_TOGETHER foci, to the map.
@compute @workgroup_size(THREADS)
fn see(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) index: u32) {
    thread = index;
    let first_focus = LAYERS_TOGETHER * group.y;
    let end = (first_focus + LAYERS_TOGETHER) * PAIRS;
    // What the map's present group has.
    var shown: array<vec4f, ITEMS>;
    // Each pair's spectra are asked for while those before are transformed.
    var next: array<Stored, ITEMS>;
    for (var item = 0u; item < ITEMS; item++) {
        next[item] = seen_spectrum(first_focus * PAIRS, end, group.x, item);
    }
    for (var slot = 0u; slot < LAYERS_TOGETHER; slot++) {
        let focus = first_focus + slot;
        var white_red: array<vec2f, ITEMS>;
        for (var pair = 0u; pair < PAIRS; pair++) {
            for (var item = 0u; item < ITEMS; item++) {
                let place = item * THREADS + thread;
                if (place < PLACES) {
                    // What the pair before has left, the second time round.
                    white_red[item] = line[place];
                    line[place] = loaded(next[item]);
                    next[item] = seen_spectrum(focus * PAIRS + pair + 1u, end, group.x, item);
                }
            }
            transform(INVERSE);
        }
        // Its three channels are in one group of the map or in two.
        let lane = 3u * focus % 4u;
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let x = place / LINES;
            let y = group.x * LINES + place % LINES;
            if (place < PLACES && y < HEIGHT) {
                let light = vec3f(white_red[item].y, line[place]) / max(white_red[item].x, LEAST_COVER / UNITARY);
                let told = sqrt(max(light, vec3f())) - 0.4f;
                let here = array(vec4f(told, 0f), vec4f(0f, told), vec4f(0f, 0f, told.xy), vec4f(0f, 0f, 0f, told.x));
                shown[item] += select(
                    select(here[0], here[1], lane == 1u),
                    select(here[2], here[3], lane == 3u),
                    lane >= 2u,
                );
                if (lane > 0u) {
                    inputs[input_place(STACK_GROUP + (3u * focus) / 4u, x, y)] = input_vector(shown[item]);
                    let rest = select(vec4f(told.z, 0f, 0f, 0f), vec4f(told.yz, 0f, 0f), lane == 3u);
                    shown[item] = select(vec4f(), rest, lane >= 2u);
                }
            }
        }
    }
    if (3u * LAYERS_TOGETHER % 4u > 0u) {
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let y = group.x * LINES + place % LINES;
            if (place < PLACES && y < HEIGHT) {
                let channels = shown[item] + told_group(3u * LAYERS / 4u);
                inputs[input_place(STACK_GROUP + 3u * LAYERS / 4u, place / LINES, y)] = input_vector(channels);
            }
        }
    }
}
