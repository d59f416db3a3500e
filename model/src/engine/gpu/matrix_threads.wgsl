// As matrix_units.wgsl, without such units: matrices are the places where they lie, and thread `lane` holds of sums row
// lane / 2, and of that the eight columns from 8·(lane % 2) on.

alias Pixels = u32;
alias Weights = u32;
alias Sums = array<vec4f, 2>;

fn load_pixels(place: u32) -> Pixels {
    return place + lane / 2u * 4u;
}

fn load_weights(place: u32) -> Weights {
    return place;
}

// Of one input channel, the weights of the outputs of group `group` in the matrix at `place`.
fn weights_of(place: u32, channel: u32, group: u32) -> vec4f {
    if WEIGHTS_BY_OUTPUT {
        let first = place + 16u * group + channel / 4u;
        let at = channel % 4u;
        return vec4f(
            f32(parameters[first][at]),
            f32(parameters[first + 4u][at]),
            f32(parameters[first + 8u][at]),
            f32(parameters[first + 12u][at]),
        );
    }
    return vec4f(parameters[place + 4u * channel + group]);
}

fn multiply_add(pixels: Pixels, weights: Weights, sums: Sums) -> Sums {
    var low = sums[0];
    var high = sums[1];
    // Always 16: a loop that drivers see the end of they would write out, and compile for seconds.
    let channels = 16u + lane / 32u;
    for (var channel = 0u; channel < channels; channel++) {
        let value = vec4f(vec4<f16>(MEMORY[pixels + channel / 4u][channel % 4u]));
        low = fma(value, weights_of(weights, channel, lane % 2u * 2u), low);
        high = fma(value, weights_of(weights, channel, lane % 2u * 2u + 1u), high);
    }
    return array(low, high);
}

fn combined(factor: f32, a: Sums, b: Sums) -> Sums {
    return array(factor * a[0] + b[0], factor * a[1] + b[1]);
}

fn scaled(factor: f32, a: Sums) -> Sums {
    return array(factor * a[0], factor * a[1]);
}

fn store_sums(sums: Sums, place: u32) {
    let first = place + lane / 2u * 4u + lane % 2u * 2u;
    finished[first] = sums[0];
    finished[first + 1u] = sums[1];
}
