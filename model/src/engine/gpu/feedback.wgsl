// What an eye lacks when it focuses on each depth layer, as feedback.rs has it; how the changes of the layers come back
// to the SLM plane is `bring_back` of depth_layers.wgsl.
//
// Before this file: fft.wgsl, pupil.wgsl, the constants of feedback.rs and what the nets' map declares as `input`.

@group(0) @binding(1) var<storage, read> pupil_mm: f32;
@group(0) @binding(2) var<storage, read> carried_spectrum: array<vec2f>; // [3, height, width], over the number of samples
// [3, height, width]: transfer functions from the SLM plane to the farthest layer, and from one to the next nearer one.
@group(0) @binding(3) var<storage, read> to_farthest: array<vec2f>;
@group(0) @binding(4) var<storage, read> step_nearer: array<vec2f>;
@group(0) @binding(5) var<storage, read_write> spectra: array<vec2f>; // [layers, 3, height, width]
@group(0) @binding(6) var<storage, read> stack: array<f32>; // [layers, 3, height, width]
// The depth layers of each block's corners, a byte each, [height, width].
@group(0) @binding(7) var<storage, read> layer_of: array<u32>;
@group(0) @binding(8) var<storage, read_write> carried: array<vec2f>; // [3, height, width]
@group(0) @binding(9) var<storage, read_write> inputs: array<input_vector>;

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
            let there = (colour * HEIGHT + y) * WIDTH + x;
            reaching[item] = times(carried_spectrum[there], to_farthest[there]);
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
                spectra[((3u * layer + colour) * HEIGHT + place / LINES) * WIDTH + x] = line[place];
            }
        }
    }
}

// Rows of the light at the layers 4·b to 4·(b + 1) of workgroup b along y: from spectra along x to those of the change
// that would give what it lacks, which goes to the map.
@compute @workgroup_size(THREADS)
fn compare(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) index: u32) {
    thread = index;
    var layers: array<u32, ITEMS>;
    for (var item = 0u; item < ITEMS; item++) {
        let place = item * THREADS + thread;
        let y = group.x * LINES + place % LINES;
        if (place < PLACES && y < HEIGHT) {
            layers[item] = layer_of[y * WIDTH + place / LINES];
        }
    }
    // Three groups of the map.
    var lacks: array<array<f32, 12>, ITEMS>;
    // What is compared in each turn is asked for while that of the one before is transformed: first there is nothing.
    var next: array<vec2f, ITEMS>;
    var next_wanted: array<f32, ITEMS>;
    for (var turn_of = 0u; turn_of <= 12u && 12u * group.y + turn_of <= 3u * LAYERS; turn_of++) {
        var wanted: array<f32, ITEMS>;
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let y = group.x * LINES + place % LINES;
            if (place < PLACES && y < HEIGHT) {
                line[place] = next[item];
                wanted[item] = next_wanted[item];
                let next_channel = 12u * group.y + turn_of;
                if (turn_of < 12u && next_channel < 3u * LAYERS) {
                    let there = (next_channel * HEIGHT + y) * WIDTH + place / LINES;
                    next[item] = spectra[there];
                    next_wanted[item] = stack[there];
                }
            }
        }
        if (turn_of == 0u) {
            continue;
        }
        let slot = turn_of - 1u;
        let channel = 12u * group.y + slot;
        transform(INVERSE);
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let y = group.x * LINES + place % LINES;
            if (place < PLACES && y < HEIGHT) {
                let arriving = line[place];
                let amplitude = sqrt(dot(arriving, arriving) + DARK_POWER);
                let lack = wanted[item] - amplitude;
                line[place] = (1f + SHARPNESS * cover(layers[item], channel / 3u)) * lack / amplitude * arriving;
                // A register is chosen by comparing: memory is what has addresses.
                for (var candidate = 0u; candidate < 12u; candidate++) {
                    lacks[item][candidate] = select(lacks[item][candidate], lack, candidate == slot);
                }
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
    for (var item = 0u; item < ITEMS; item++) {
        let place = item * THREADS + thread;
        let x = place / LINES;
        let y = group.x * LINES + place % LINES;
        if (place < PLACES && y < HEIGHT) {
            for (var part = 0u; part < 3u; part++) {
                let map_group = LACK_GROUP + 3u * group.y + part;
                let first = 4u * part;
                if (map_group < INPUT_GROUPS) {
                    let lack = vec4f(
                        lacks[item][first],
                        lacks[item][first + 1u],
                        lacks[item][first + 2u],
                        lacks[item][first + 3u],
                    );
                    inputs[input_place(map_group, x, y)] = input_vector(lack);
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

// Rows of the mean change, from spectra along x, which the field takes a share of; both go to the map.
@compute @workgroup_size(THREADS)
fn change(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) index: u32) {
    thread = index;
    var fields: array<array<vec2f, 3>, ITEMS>;
    var changes: array<array<vec2f, 3>, ITEMS>;
    for (var colour = 0u; colour < 3u; colour++) {
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let y = group.x * LINES + place % LINES;
            if (place < PLACES && y < HEIGHT) {
                line[place] = spectra[(colour * HEIGHT + y) * WIDTH + place / LINES];
            }
        }
        transform(INVERSE);
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let y = group.x * LINES + place % LINES;
            if (place < PLACES && y < HEIGHT) {
                let there = (colour * HEIGHT + y) * WIDTH + place / LINES;
                let mean = line[place] / f32(LAYERS);
                let field = carried[there] + SHARE * mean;
                carried[there] = field;
                for (var candidate = 0u; candidate < 3u; candidate++) {
                    fields[item][candidate] = select(fields[item][candidate], field, candidate == colour);
                    changes[item][candidate] = select(changes[item][candidate], mean, candidate == colour);
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
