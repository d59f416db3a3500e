// Complex numbers as buffers hold them between passes: in half precision, to 2^-11 of a number, and to 6e-8 of those
// below 6e-5. It ends at 65504; the largest number is the sum of a uniform field, the square root of its samples (1440
// for a panel of 3840x2160).

alias Stored = u32;

fn stored(value: vec2f) -> Stored {
    return pack2x16float(value);
}

fn loaded(value: Stored) -> vec2f {
    return unpack2x16float(value);
}
