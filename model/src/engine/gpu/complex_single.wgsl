// Complex numbers as buffers hold them between passes: in single precision.

alias Stored = vec2f;

fn stored(value: vec2f) -> Stored {
    return value;
}

fn loaded(value: Stored) -> vec2f {
    return value;
}
