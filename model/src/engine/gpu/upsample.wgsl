// The field on the panel's grid from that on the network's, as upsample.rs computes it by Fourier's way.
//
// A sample lies in the middle of its 2x2 block: the panel's pixels are a quarter of a sample before and behind it. So a
// spectrum that is turned by a quarter of a sample each way and transformed back gives every second pixel, and nothing
// longer than a line of samples is ever transformed.
//
// Before this file: fft.wgsl, the constants of upsample.rs and what has `low`.

@group(0) @binding(3) var<storage, read_write> small: array<Stored>; // [3, height, width]
@group(0) @binding(4) var<storage, read_write> tall: array<Stored>; // [3, frame height, width]
@group(0) @binding(5) var<storage, read_write> field: array<Stored>; // [3, frame height, frame width]
// Of each bin of a line: the turn that leads a quarter of a sample back, over the number of samples, or its root where
// the spectrum is one of a unitary transform; zero at Nyquist.
@group(0) @binding(6) var<storage, read> quarter: array<vec2f>;

// The turn of bin `bin` to the first pixel of each sample, or the second.
fn to_pixel(bin: u32, second: u32) -> vec2f {
    let turn_back = quarter[bin];
    return vec2f(turn_back.x, select(turn_back.y, -turn_back.y, second == 1u));
}

// Rows of the field on the network's grid, to spectra along x.
@compute @workgroup_size(THREADS)
fn correct(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) index: u32) {
    thread = index;
    var fields: array<array<vec2f, 3>, ITEMS>;
    for (var item = 0u; item < ITEMS; item++) {
        let place = item * THREADS + thread;
        let y = group.x * LINES + place % LINES;
        if (place < PLACES && y < HEIGHT) {
            fields[item] = low(place / LINES, y);
        }
    }
    for (var colour = 0u; colour < 3u; colour++) {
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            if (place < PLACES) {
                let red_or_green = select(fields[item][0], fields[item][1], colour == 1u);
                line[place] = UNITARY * select(red_or_green, fields[item][2], colour == 2u);
            }
        }
        transform(FORWARD);
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let y = group.x * LINES + place % LINES;
            if (place < PLACES && y < HEIGHT) {
                small[(colour * HEIGHT + y) * WIDTH + place / LINES] = stored(line[place]);
            }
        }
    }
}

// Columns of one colour, from spectra along x to twice as many of them.
@compute @workgroup_size(THREADS)
fn double_columns(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) index: u32) {
    thread = index;
    let colour = group.y;
    for (var item = 0u; item < ITEMS; item++) {
        let place = item * THREADS + thread;
        let x = group.x * LINES + place % LINES;
        if (place < PLACES && x < WIDTH) {
            line[place] = loaded(small[(colour * HEIGHT + place / LINES) * WIDTH + x]);
        }
    }
    transform(FORWARD);
    var spectrum: array<vec2f, ITEMS>;
    for (var item = 0u; item < ITEMS; item++) {
        let place = item * THREADS + thread;
        if (place < PLACES) {
            spectrum[item] = line[place];
        }
    }
    for (var second = 0u; second < 2u; second++) {
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            if (place < PLACES) {
                line[place] = times(spectrum[item], to_pixel(place / LINES, second));
            }
        }
        transform(INVERSE);
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            let x = group.x * LINES + place % LINES;
            let y = 2u * (place / LINES) + second;
            if (place < PLACES && x < WIDTH && y < FRAME_HEIGHT) {
                tall[(colour * FRAME_HEIGHT + y) * WIDTH + x] = stored(line[place]);
            }
        }
    }
}

// Rows of one colour, from spectra along x to the field.
@compute @workgroup_size(THREADS)
fn double_rows(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) index: u32) {
    thread = index;
    let colour = group.y;
    var spectrum: array<vec2f, ITEMS>;
    for (var item = 0u; item < ITEMS; item++) {
        let place = item * THREADS + thread;
        let y = group.x * LINES + place % LINES;
        if (place < PLACES && y < FRAME_HEIGHT) {
            spectrum[item] = loaded(tall[(colour * FRAME_HEIGHT + y) * WIDTH + place / LINES]);
        }
    }
    var first: array<vec2f, ITEMS>;
    for (var second = 0u; second < 2u; second++) {
        for (var item = 0u; item < ITEMS; item++) {
            let place = item * THREADS + thread;
            if (place < PLACES) {
                // What the first pixels' turn has left, the second time round.
                first[item] = line[place];
                line[place] = times(spectrum[item], to_pixel(place / LINES, second));
            }
        }
        transform(INVERSE);
    }
    for (var item = 0u; item < ITEMS; item++) {
        let place = item * THREADS + thread;
        let x = 2u * (place / LINES);
        let y = group.x * LINES + place % LINES;
        if (place < PLACES && y < FRAME_HEIGHT) {
            let there = (colour * FRAME_HEIGHT + y) * FRAME_WIDTH + x;
            field[there] = stored(first[item]);
            if (x + 1u < FRAME_WIDTH) {
                field[there + 1u] = stored(line[place]);
            }
        }
    }
}
