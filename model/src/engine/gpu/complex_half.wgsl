// Complex numbers as buffers hold them between passes: in half precision, which ends at 65504 and is coarser than 2^-11
// of a number below 6e-5. What unitary transforms make of fields around 1 is far from both.

alias Stored = u32;

fn stored(value: vec2f) -> Stored {
    return pack2x16float(value);
}

fn loaded(value: Stored) -> vec2f {
    return unpack2x16float(value);
}
