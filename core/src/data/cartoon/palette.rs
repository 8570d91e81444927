//! Colours that look well together, and their way between sRGB and linear light.

use glam::Vec3;

use super::identity::Colour;
use crate::rng::Stream;

/// Skin tones from fair to deep.
const SKIN: [[u8; 3]; 12] = [
    [255, 222, 200],
    [250, 208, 180],
    [245, 196, 160],
    [238, 182, 142],
    [228, 168, 124],
    [214, 150, 106],
    [196, 130, 88],
    [176, 112, 74],
    [150, 92, 62],
    [124, 76, 52],
    [100, 62, 44],
    [82, 52, 40],
];
/// Skins of no human.
const FANTASTIC_SKIN: [[u8; 3]; 5] =
    [[150, 205, 130], [140, 180, 235], [200, 160, 230], [120, 210, 205], [240, 160, 175]];
/// Natural hair from black to white.
const HAIR: [[u8; 3]; 12] = [
    [34, 28, 30],
    [52, 38, 34],
    [74, 50, 38],
    [104, 66, 42],
    [136, 84, 48],
    [150, 70, 36],
    [186, 88, 40],
    [196, 142, 78],
    [226, 180, 106],
    [240, 208, 146],
    [168, 164, 164],
    [226, 222, 220],
];
/// Dyed hair.
const DYED_HAIR: [[u8; 3]; 6] =
    [[232, 96, 150], [80, 140, 220], [120, 90, 200], [60, 180, 160], [230, 80, 70], [150, 205, 90]];
const IRIS: [[u8; 3]; 8] = [
    [92, 54, 30],
    [120, 74, 36],
    [150, 100, 44],
    [60, 110, 180],
    [84, 150, 200],
    [70, 140, 90],
    [110, 130, 130],
    [130, 110, 60],
];
/// Garments: main colour and one that goes with it.
const OUTFITS: [[[u8; 3]; 2]; 16] = [
    [[222, 76, 70], [250, 236, 220]],
    [[46, 92, 160], [240, 240, 236]],
    [[250, 190, 70], [70, 80, 120]],
    [[70, 160, 140], [245, 232, 205]],
    [[60, 66, 84], [236, 120, 80]],
    [[244, 240, 232], [72, 110, 170]],
    [[232, 130, 150], [255, 240, 240]],
    [[120, 92, 170], [245, 210, 110]],
    [[110, 150, 80], [240, 230, 200]],
    [[236, 130, 60], [60, 70, 90]],
    [[140, 196, 230], [250, 250, 250]],
    [[150, 60, 80], [236, 200, 170]],
    [[48, 110, 104], [230, 180, 90]],
    [[96, 140, 190], [110, 70, 60]],
    [[38, 50, 76], [220, 70, 80]],
    [[196, 226, 208], [200, 90, 100]],
];
/// Backdrops: below, above, accent.
const BACKDROPS: [[[u8; 3]; 3]; 14] = [
    [[250, 214, 180], [240, 150, 140], [255, 240, 200]],
    [[190, 226, 236], [96, 160, 214], [250, 250, 240]],
    [[214, 236, 200], [120, 184, 160], [250, 244, 190]],
    [[250, 230, 190], [246, 190, 110], [255, 250, 230]],
    [[226, 206, 240], [150, 130, 204], [255, 226, 240]],
    [[250, 210, 220], [226, 140, 170], [255, 244, 244]],
    [[70, 90, 130], [36, 46, 84], [250, 200, 120]],
    [[214, 214, 220], [156, 164, 180], [240, 244, 250]],
    [[60, 120, 120], [30, 70, 84], [170, 230, 200]],
    [[240, 232, 216], [214, 200, 180], [255, 255, 250]],
    [[250, 190, 150], [110, 110, 180], [255, 230, 180]],
    [[160, 210, 210], [250, 214, 190], [255, 255, 240]],
    [[110, 70, 110], [56, 40, 84], [250, 150, 160]],
    [[190, 220, 150], [100, 190, 220], [255, 250, 200]],
];
const VIVID: [[u8; 3]; 10] = [
    [226, 70, 80],
    [250, 180, 60],
    [60, 150, 200],
    [90, 180, 120],
    [240, 130, 170],
    [130, 100, 190],
    [244, 240, 230],
    [50, 60, 90],
    [236, 110, 60],
    [64, 170, 170],
];
const LIPSTICK: [[u8; 3]; 6] =
    [[206, 44, 60], [226, 90, 110], [170, 40, 70], [236, 110, 100], [150, 60, 90], [214, 70, 130]];

/// What a person's regions share when they are first drawn.
#[derive(Clone, Debug)]
pub(super) struct Complexion {
    /// Skin.
    pub skin: Colour,
    /// Hair.
    pub hair: Colour,
    /// Taste in cuts, lashes and make-up, in [0, 1].
    pub persona: f32,
    /// Whether the skin is no human's.
    pub fantastic: bool,
}

impl Complexion {
    /// Deep skins go with dark hair more often than not; one head in seven is dyed; one in fifteen is not human.
    pub fn draw(stream: &mut Stream) -> Self {
        let fantastic = stream.chance(0.065);
        let depth = stream.uniform();
        let skin = if fantastic { one_of(stream, &FANTASTIC_SKIN) } else { along(&SKIN, depth) };
        let dyed = stream.chance(if fantastic { 0.6 } else { 0.13 });
        let lightest = if depth > 0.6 && stream.chance(0.85) { 0.4 } else { 1.0 };
        let natural = along(&HAIR, stream.uniform().powf(1.15) * lightest);
        let hair = if dyed { one_of(stream, &DYED_HAIR) } else { natural };
        let persona = stream.uniform();
        let persona = persona * persona * (3.0 - 2.0 * persona);
        Self { skin: jitter(stream, skin, 0.02), hair: jitter(stream, hair, 0.03), persona, fantastic }
    }

    /// Brows a little darker than the hair, and never lost on the skin.
    pub fn brow(&self, stream: &mut Stream) -> Colour {
        let darker = std::array::from_fn(|channel| self.hair[channel] * 0.72);
        let contrast = luminance(self.skin) - luminance(darker);
        let shade = if contrast < 0.16 { 0.5 } else { 1.0 };
        jitter(stream, darker.map(|value| value * shade), 0.02)
    }
}

/// An iris colour.
pub(super) fn iris(stream: &mut Stream) -> Colour {
    let colour = one_of(stream, &IRIS);
    jitter(stream, colour, 0.05)
}

/// A lipstick and how strongly it is worn.
pub(super) fn lipstick(stream: &mut Stream) -> (Colour, f32) {
    (one_of(stream, &LIPSTICK), stream.range(0.55, 0.95))
}

/// A strong colour for ribbons and hats.
pub(super) fn vivid(stream: &mut Stream) -> Colour {
    let colour = one_of(stream, &VIVID);
    jitter(stream, colour, 0.04)
}

/// A garment's two colours.
pub(super) fn outfit(stream: &mut Stream) -> (Colour, Colour) {
    let [main, second] = OUTFITS[stream.below(OUTFITS.len())];
    (jitter(stream, colour(main), 0.04), jitter(stream, colour(second), 0.02))
}

/// A backdrop's colours: below, above, accent.
pub(super) fn backdrop(stream: &mut Stream) -> [Colour; 3] {
    BACKDROPS[stream.below(BACKDROPS.len())].map(|bytes| jitter(stream, colour(bytes), 0.03))
}

fn colour(bytes: [u8; 3]) -> Colour {
    bytes.map(|byte| f32::from(byte) / 255.0)
}

fn one_of<const N: usize>(stream: &mut Stream, colours: &[[u8; 3]; N]) -> Colour {
    colour(colours[stream.below(N)])
}

/// A colour between neighbours of an ordered palette.
fn along<const N: usize>(colours: &[[u8; 3]; N], place: f32) -> Colour {
    let place = place.clamp(0.0, 1.0) * (N - 1) as f32;
    let low = (place as usize).min(N - 2);
    let (from, to, share) = (colour(colours[low]), colour(colours[low + 1]), place - low as f32);
    std::array::from_fn(|channel| from[channel] + share * (to[channel] - from[channel]))
}

fn jitter(stream: &mut Stream, colour: Colour, spread: f32) -> Colour {
    colour.map(|value| (value + spread * stream.range(-1.0, 1.0)).clamp(0.02, 1.0))
}

fn luminance([red, green, blue]: Colour) -> f32 {
    0.299 * red + 0.587 * green + 0.114 * blue
}

/// Linear light of an sRGB colour.
pub(super) fn linear(colour: Colour) -> Vec3 {
    Vec3::from_array(colour.map(
        |value| {
            if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
        },
    ))
}

/// sRGB of linear light, each component clamped to [0, 1].
pub(super) fn encode(light: Vec3) -> Colour {
    light.to_array().map(|value| {
        let value = value.clamp(0.0, 1.0);
        if value <= 0.003_130_8 { 12.92 * value } else { 1.055 * value.powf(1.0 / 2.4) - 0.055 }
    })
}
