//! The models the binary carries.

/// Names of the built-in models.
pub const NAMES: [&str; 2] = ["portrait", "cartoon"];

/// The file of the built-in model called `name`.
pub fn bytes(name: &str) -> Option<&'static [u8]> {
    match name {
        "portrait" => Some(include_bytes!("../../../models/portrait.safetensors")),
        "cartoon" => Some(include_bytes!("../../../models/cartoon.safetensors")),
        _ => None,
    }
}
