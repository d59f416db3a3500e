// What an eye lacks when it focuses on each depth layer, as feedback.rs has it; how the changes of the layers come back
// to the SLM plane is `bring_back` of depth_layers.wgsl.
//
// Before this file: fft.wgsl, pupil.wgsl, transfer_tables.wgsl, expected.wgsl and the constants of feedback.rs.

@group(0) @binding(1) var<storage, read> pupil_mm: f32;
@group(0) @binding(2) var<storage, read> carried_spectrum: array<Stored>; // [3, height, width]
// Transfer functions from the SLM plane to the farthest layer, times UNITARY, and from one to the next nearer one.
@group(0) @binding(3) var<storage, read> to_farthest: array<vec2f>;
@group(0) @binding(4) var<storage, read> step_nearer: array<vec2f>;
@group(0) @binding(5) var<storage, read_write> spectra: array<Stored>; // [layers, 3, height, width]
// [layers, 3, height, width]: where they are refined, the amplitudes that an eye should see.
@group(0) @binding(6) var<storage, read> stack: array<Amplitude>;
// The depth layers of each block's corners, a byte each, [height, width].
@group(0) @binding(7) var<storage, read> layer_of: array<u32>;
// [3, height, width]: along x, the spectra of the carried field and of the layers' changes.
@group(0) @binding(8) var<storage, read> carried_rows: array<Stored>;
@group(0) @binding(9) var<storage, read> changed_rows: array<Stored>;
@group(0) @binding(10) var<storage, read_write> inputs: array<input_vector>;

// Columns of one colour: from the spectrum of the field at the SLM plane to spectra along x of what reaches each layer
// through the pupil.
@compute @workgroup_size(THREADS)
fn send(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) index: u32) {
    thread = index;
    let colour = group.y;
    var reaching: array<vec2f, ITEMS>;
    var steps: array<vec2f, ITEMS>;
    for (var item = 0u; item < ITEMS; item++) {
        let place = item * THREADS + thread;
        let x = group.x * LINES + place % LINES;
        let y = place / LINES;
        if (place < PLACES && x < WIDTH && passes_pupil(x, y, colour, pupil_mm)) {
            let there = table_place(colour, x, y);
            let carried = loaded(carried_spectrum[(colour * HEIGHT + y) * WIDTH + x]);
            reaching[item] = times(carried, to_farthest[there]);
            steps[item] = step_nearer[there];
        }
    }
    for (var layer = 0u; layer < LAYERS; layer++) {
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            if (place < PLACES) {
                line[place] = reaching[item];
                reaching[item] = times(reaching[item], steps[item]);
            }
        }
        transform(INVERSE);
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let x = group.x * LINES + place % LINES;
            if (place < PLACES && x < WIDTH) {
                spectra[((3u * layer + colour) * HEIGHT + place / LINES) * WIDTH + x] = stored(line[place]);
            }
        }
    }
}

// What is wanted in channel 3·layer + colour.
fn wanted_amplitude(channel: u32, x: u32, y: u32) -> f32 {
    if (REFINES) {
        return f32(stack[(channel * HEIGHT + y) * WIDTH + x]);
    }
    return expected(channel, x, y);
}

// Rows of the light at LAYERS_TOGETHER layers: from spectra along x to those of the change that would give what it
// lacks, which goes to the map.
@compute @workgroup_size(THREADS)
fn compare(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) index: u32) {
    thread = index;
    let first_channel = 3u * LAYERS_TOGETHER * group.y;
    var layers: array<u32, ITEMS>;
    // What the map's present group has.
    var lacks: array<vec4f, ITEMS>;
    // What is compared next is asked for while that before is transformed.
    var next: array<Stored, ITEMS>;
    var next_wanted: array<f32, ITEMS>;
    for (var item = 0u; item < ITEMS; item++) {
        let place = item * THREADS + thread;
        let x = place / LINES;
        let y = group.x * LINES + place % LINES;
        if (place < PLACES && y < HEIGHT) {
            layers[item] = layer_of[y * WIDTH + x];
            next[item] = spectra[(first_channel * HEIGHT + y) * WIDTH + x];
            next_wanted[item] = wanted_amplitude(first_channel, x, y);
        }
    }
    for (var slot = 0u; slot < 3u * LAYERS_TOGETHER; slot++) {
        let channel = first_channel + slot;
        let last = slot + 1u == 3u * LAYERS_TOGETHER;
        var wanted: array<f32, ITEMS>;
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let x = place / LINES;
            let y = group.x * LINES + place % LINES;
            if (place < PLACES && y < HEIGHT) {
                line[place] = loaded(next[item]);
                wanted[item] = next_wanted[item];
                if (!last) {
                    next[item] = spectra[((channel + 1u) * HEIGHT + y) * WIDTH + x];
                    next_wanted[item] = wanted_amplitude(channel + 1u, x, y);
                }
            }
        }
        transform(INVERSE);
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let y = group.x * LINES + place % LINES;
            if (place < PLACES && y < HEIGHT) {
                let arriving = UNITARY * line[place];
                let amplitude = sqrt(dot(arriving, arriving) + DARK_POWER);
                let lack = wanted[item] - amplitude;
                let weight = UNITARY * (1f + SHARPNESS * cover(layers[item], channel / 3u));
                line[place] = weight * lack / amplitude * arriving;
                // A register is chosen by comparing: memory is what has addresses.
                let chosen = vec4u(channel % 4u) == vec4u(0u, 1u, 2u, 3u);
                lacks[item] = select(select(lacks[item], vec4f(), channel % 4u == 0u), vec4f(lack), chosen);
            }
        }
        transform(FORWARD);
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let x = place / LINES;
            let y = group.x * LINES + place % LINES;
            if (place < PLACES && y < HEIGHT) {
                spectra[(channel * HEIGHT + y) * WIDTH + x] = stored(line[place]);
                if (channel % 4u == 3u || last) {
                    inputs[input_place(LACK_GROUP + channel / 4u, x, y)] = input_vector(lacks[item]);
                }
            }
        }
    }
}

// The share of a block in one layer.
fn cover(layers: u32, layer: u32) -> f32 {
    var corners = 0f;
    for (var corner = 0u; corner < 4u; corner++) {
        corners += select(0f, 1f, (layers >> (8u * corner) & 0xffu) == layer);
    }
    return corners / 4f;
}

// Rows of the carried field and of the mean change, from spectra along x: the field takes a share of that change, and
// both go to the map.
@compute @workgroup_size(THREADS)
fn change(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) index: u32) {
    thread = index;
    var fields: array<array<vec2f, 3>, ITEMS>;
    var changes: array<array<vec2f, 3>, ITEMS>;
    for (var colour = 0u; colour < 3u; colour++) {
        var next: array<Stored, ITEMS>;
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let y = group.x * LINES + place % LINES;
            if (place < PLACES && y < HEIGHT) {
                let there = (colour * HEIGHT + y) * WIDTH + place / LINES;
                line[place] = loaded(carried_rows[there]);
                next[item] = changed_rows[there];
            }
        }
        transform(INVERSE);
        var field: array<vec2f, ITEMS>;
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            if (place < PLACES) {
                field[item] = UNITARY * line[place];
                line[place] = loaded(next[item]);
            }
        }
        transform(INVERSE);
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            if (place < PLACES) {
                let mean = UNITARY / f32(LAYERS) * line[place];
                for (var candidate = 0u; candidate < 3u; candidate++) {
                    let chosen = candidate == colour;
                    fields[item][candidate] = select(fields[item][candidate], field[item] + SHARE * mean, chosen);
                    changes[item][candidate] = select(changes[item][candidate], mean, chosen);
                }
            }
        }
    }
    for (var item = 0u; item < ITEMS; item++) {
        let place = item * THREADS + thread;
        let x = place / LINES;
        let y = group.x * LINES + place % LINES;
        if (place < PLACES && y < HEIGHT) {
            let field = fields[item];
            let mean = changes[item];
            let part0 = vec4f(field[0].x, field[1].x, field[2].x, field[0].y);
            let part1 = vec4f(field[1].y, field[2].y, mean[0].x, mean[1].x);
            let part2 = vec4f(mean[2].x, mean[0].y, mean[1].y, mean[2].y);
            inputs[input_place(FIELD_GROUP + 0u, x, y)] = input_vector(part0);
            inputs[input_place(FIELD_GROUP + 1u, x, y)] = input_vector(part1);
            inputs[input_place(FIELD_GROUP + 2u, x, y)] = input_vector(part2);
        }
    }
}
