// Products of matrices of 16 by 16 numbers, on the units of the device: the threads of a subgroup hold each matrix
// together. What `MEMORY` stands for is the shader's memory of pixels. Before this file: WEIGHTS_BY_OUTPUT.

// [pixel, input channel], [input channel, output channel], and sums [pixel, output channel].
alias Pixels = coop_mat16x16<f16, A>;
alias Weights = coop_mat16x16<f16, B>;
alias Sums = coop_mat16x16<f32, C>;

fn load_pixels(place: u32) -> Pixels {
    return coopLoadT<Pixels>(&MEMORY[place], 4u);
}

fn load_weights(place: u32) -> Weights {
    if WEIGHTS_BY_OUTPUT {
        return coopLoad<Weights>(&parameters[place], 4u);
    }
    return coopLoadT<Weights>(&parameters[place], 4u);
}

fn multiply_add(pixels: Pixels, weights: Weights, sums: Sums) -> Sums {
    return coopMultiplyAdd(pixels, weights, sums);
}

// factor·a + b.
fn combined(factor: f32, a: Sums, b: Sums) -> Sums {
    return a * factor + b;
}

fn scaled(factor: f32, a: Sums) -> Sums {
    return a * factor;
}

fn store_sums(sums: Sums, place: u32) {
    coopStoreT(sums, &finished[place], 4u);
}
