//! The models the binary carries; what they are stands in `README.md` beside them.

/// Names of the built-in models.
pub const NAMES: [&str; 2] = ["portrait", "cartoon"];

/// The file of the built-in model called `name`.
pub fn bytes(name: &str) -> Option<&'static [u8]> {
    match name {
        "portrait" => Some(include_bytes!("../portrait.safetensors")),
        "cartoon" => Some(include_bytes!("../cartoon.safetensors")),
        _ => None,
    }
}

/// The file of the built-in face parser.
pub fn parser() -> &'static [u8] {
    include_bytes!("../parser.safetensors")
}

/// The file of the near start of the built-in model called `name`.
pub fn start(name: &str) -> Option<&'static [u8]> {
    match name {
        "portrait" => Some(include_bytes!("../portrait_start.safetensors")),
        "cartoon" => Some(include_bytes!("../cartoon_start.safetensors")),
        _ => None,
    }
}
