//! Who a portrait shows: independent parameters for every region, drawn each from its own stream.
//!
//! Lengths are in head units (half a head's width is about 0.9); colours are sRGB in [0, 1].

use serde::{Deserialize, Serialize};

use super::palette;
use crate::{region::Region, rng::Stream};

/// sRGB colour, each component in [0, 1].
pub type Colour = [f32; 3];

/// Names the cartoons' draws among all streams of the suite.
const STREAM: u64 = 0x00ca_4700;
/// Draws that regions share at the first sampling: a person's complexion.
const COMPLEXION: u64 = 100;

/// Everything a cartoon portrait is made from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Identity {
    /// Backdrop.
    pub background: Background,
    /// Head and face.
    pub face: Face,
    /// Eyes.
    pub eyes: Eyes,
    /// Eyebrows.
    pub eyebrows: Eyebrows,
    /// Mouth.
    pub mouth: Mouth,
    /// Nose.
    pub nose: Nose,
    /// Ears.
    pub ears: Ears,
    /// Hair.
    pub hair: Hair,
    /// Neck and clothes.
    pub neck: Neck,
}

/// Head and face.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Face {
    /// Colour of all skin.
    pub skin: Colour,
    /// Width of the skull, 1 is average.
    pub head_width: f32,
    /// Height of the skull, 1 is average.
    pub head_height: f32,
    /// Depth of the skull, 1 is average.
    pub head_depth: f32,
    /// Width of the jaw, 1 is average.
    pub jaw_width: f32,
    /// How far the face reaches down, 1 is average.
    pub face_length: f32,
    /// Size of the chin, 1 is average.
    pub chin_size: f32,
    /// How far the chin stands forward.
    pub chin_forward: f32,
    /// Fullness of the cheeks, 1 is average.
    pub cheek_size: f32,
    /// Height of the cheeks over average.
    pub cheek_height: f32,
    /// Strength of the cheeks' blush in [0, 1].
    pub blush: f32,
    /// Strength of freckles in [0, 1].
    pub freckles: f32,
}

/// Eyes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Eyes {
    /// Radius of the eyeballs.
    pub size: f32,
    /// Half the distance of their centres.
    pub spacing: f32,
    /// Height of their centres.
    pub height: f32,
    /// Rise of the outer corners, radians.
    pub tilt_rad: f32,
    /// Iris colour.
    pub iris: Colour,
    /// Angular radius of the iris, radians.
    pub iris_rad: f32,
    /// Radius of the pupil as a share of the iris.
    pub pupil: f32,
    /// Opening of the upper lid above the eye's axis, radians.
    pub upper_lid_rad: f32,
    /// Opening of the lower lid below the eye's axis, radians.
    pub lower_lid_rad: f32,
    /// Gaze to the side, radians; positive looks to +x.
    pub gaze_azimuth_rad: f32,
    /// Gaze upwards, radians.
    pub gaze_elevation_rad: f32,
    /// Length of the lashes in [0, 1].
    pub lashes: f32,
}

/// Eyebrows.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Eyebrows {
    /// Colour.
    pub colour: Colour,
    /// Radius at the thickest place.
    pub thickness: f32,
    /// Half length.
    pub length: f32,
    /// Height of the middle over the ends.
    pub arch: f32,
    /// Rise of the outer ends, radians.
    pub tilt_rad: f32,
    /// Height over the eyes' upper rim.
    pub height: f32,
    /// How much higher the one at +x sits than the other.
    pub raise: f32,
}

/// Mouth.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Mouth {
    /// Half width.
    pub width: f32,
    /// Place between the nose (0) and the chin (1).
    pub place: f32,
    /// Rise of the corners; negative droops.
    pub smile: f32,
    /// Height of the opening, 0 closed.
    pub open: f32,
    /// Thickness of the lips, 1 is average.
    pub fullness: f32,
    /// Colour of the lips over the skin; `tint` says how much of it.
    pub lip_colour: Colour,
    /// How far the lips' colour is from the skin's, in [0, 1].
    pub tint: f32,
}

/// Nose.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Nose {
    /// Height from the bridge to the tip.
    pub length: f32,
    /// Distance of the nostrils, 1 is average.
    pub width: f32,
    /// Radius of the tip.
    pub bulb: f32,
    /// Radius of the bridge.
    pub bridge: f32,
    /// How far the tip stands forward.
    pub forward: f32,
}

/// Ears.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ears {
    /// Half height.
    pub size: f32,
    /// Angle off the head, radians.
    pub angle_rad: f32,
    /// Height over the eyes.
    pub height: f32,
    /// How pointed the upper rim is; 0 human, 1 elfin.
    pub point: f32,
    /// Whether ear studs are worn.
    pub studs: bool,
}

/// Cut of the hair.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HairStyle {
    /// No hair.
    Bald,
    /// Clipped close to the scalp.
    Buzz,
    /// Short, with tufts combed to the front.
    Crop,
    /// Parted on a side and swept over.
    SidePart,
    /// High, swept up and back.
    Quiff,
    /// Cut straight around the head.
    Bowl,
    /// Short curls.
    Curly,
    /// A large round of curls.
    Afro,
    /// Pulled back into a bun.
    Bun,
    /// To the jaw.
    Bob,
    /// Straight, over the shoulders.
    Long,
    /// Long and wavy.
    Wavy,
    /// Pulled back into a tail.
    Ponytail,
    /// A tail on either side.
    Pigtails,
    /// A braid on either side.
    Braids,
    /// A crest of spikes.
    Mohawk,
    /// Spikes all over.
    Spiky,
    /// A knitted hat with some hair below.
    Beanie,
}

impl HairStyle {
    /// All styles.
    pub const ALL: [Self; 18] = [
        Self::Bald,
        Self::Buzz,
        Self::Crop,
        Self::SidePart,
        Self::Quiff,
        Self::Bowl,
        Self::Curly,
        Self::Afro,
        Self::Bun,
        Self::Bob,
        Self::Long,
        Self::Wavy,
        Self::Ponytail,
        Self::Pigtails,
        Self::Braids,
        Self::Mohawk,
        Self::Spiky,
        Self::Beanie,
    ];

    /// Whether the hair falls over the ears.
    pub const fn covers_ears(self) -> bool {
        matches!(self, Self::Bob | Self::Long | Self::Wavy)
    }
}

/// Hair.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Hair {
    /// Cut.
    pub style: HairStyle,
    /// Colour.
    pub colour: Colour,
    /// Colour of ribbons, ties and hats.
    pub accent: Colour,
    /// Volume in [0, 1].
    pub volume: f32,
    /// Length in [0, 1], within what the style allows.
    pub length: f32,
    /// Height of the hairline over average.
    pub hairline: f32,
    /// Whether a fringe covers the forehead, where the style allows it.
    pub fringe: bool,
    /// Side of the parting: 1 at +x, −1 at −x.
    pub side: f32,
    /// Seed of the locks' irregularities.
    pub tousle: u64,
}

/// What is worn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Garment {
    /// Round neck with a rib.
    TShirt,
    /// Pointed neck.
    VNeck,
    /// With a hood and strings.
    Hoodie,
    /// With a folded collar and buttons.
    Shirt,
    /// Folded up the neck.
    Turtleneck,
    /// Straps over bare shoulders.
    Straps,
    /// A thick round scarf over a plain top.
    Scarf,
}

impl Garment {
    /// All garments.
    pub const ALL: [Self; 7] =
        [Self::TShirt, Self::VNeck, Self::Hoodie, Self::Shirt, Self::Turtleneck, Self::Straps, Self::Scarf];
}

/// What is printed or knitted on a garment.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Pattern {
    /// One colour.
    Plain,
    /// Level stripes.
    Stripes,
    /// Dots.
    Dots,
    /// Sleeves in the second colour.
    Raglan,
    /// Vertical ribs.
    Ribs,
}

/// Neck and clothes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Neck {
    /// Radius of the neck, 1 is average.
    pub width: f32,
    /// Width of the shoulders, 1 is average.
    pub shoulders: f32,
    /// What is worn.
    pub garment: Garment,
    /// Its colour.
    pub colour: Colour,
    /// Its second colour.
    pub trim: Colour,
    /// What is on it.
    pub pattern: Pattern,
}

/// Kind of backdrop.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BackgroundKind {
    /// One colour, a little lighter in the middle.
    Flat,
    /// From one colour below to another above.
    Gradient,
    /// A gradient with soft discs of light.
    Bokeh,
    /// A gradient with a large sun and hills, out of focus.
    Hills,
}

/// Backdrop: colours on a sphere around the head, so that it turns with the cameras.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Background {
    /// Kind.
    pub kind: BackgroundKind,
    /// Colour below.
    pub lower: Colour,
    /// Colour above.
    pub upper: Colour,
    /// Colour of discs, sun and hills.
    pub accent: Colour,
    /// Seed of where the shapes stand.
    pub arrangement: u64,
}

impl Identity {
    /// The person with this seed. Every region has a stream of its own; what people's regions share (complexion: skin
    /// goes with hair and brows) comes from one more.
    pub fn sample(seed: u64) -> Self {
        let draws = |region: Region| Stream::new(seed, &[STREAM, region.index() as u64]);
        let complexion = palette::Complexion::draw(&mut Stream::new(seed, &[STREAM, COMPLEXION]));
        Self {
            background: Background::draw(&mut draws(Region::Background)),
            face: Face::draw(&mut draws(Region::Face), &complexion),
            eyes: Eyes::draw(&mut draws(Region::Eyes), &complexion),
            eyebrows: Eyebrows::draw(&mut draws(Region::Eyebrows), &complexion),
            mouth: Mouth::draw(&mut draws(Region::Mouth), &complexion),
            nose: Nose::draw(&mut draws(Region::Nose)),
            ears: Ears::draw(&mut draws(Region::Ears), &complexion),
            hair: Hair::draw(&mut draws(Region::Hair), &complexion),
            neck: Neck::draw(&mut draws(Region::Neck)),
        }
    }

    /// Gives `region` the parameters it has in the person with this seed; all others stay.
    pub fn redraw(&mut self, region: Region, seed: u64) {
        let donor = Self::sample(seed);
        match region {
            Region::Background => self.background = donor.background,
            Region::Face => self.face = donor.face,
            Region::Eyes => self.eyes = donor.eyes,
            Region::Eyebrows => self.eyebrows = donor.eyebrows,
            Region::Mouth => self.mouth = donor.mouth,
            Region::Nose => self.nose = donor.nose,
            Region::Ears => self.ears = donor.ears,
            Region::Hair => self.hair = donor.hair,
            Region::Neck => self.neck = donor.neck,
        }
    }
}

/// A normal draw that stays within `spread` of `mean`, most often within half of it.
fn around(stream: &mut Stream, mean: f32, spread: f32) -> f32 {
    mean + spread * (0.5 * stream.normal()).clamp(-1.0, 1.0)
}

impl Face {
    fn draw(stream: &mut Stream, complexion: &palette::Complexion) -> Self {
        Self {
            skin: complexion.skin,
            head_width: around(stream, 1.0, 0.08),
            head_height: around(stream, 1.0, 0.07),
            head_depth: around(stream, 1.0, 0.06),
            jaw_width: around(stream, 1.0, 0.14),
            face_length: around(stream, 1.0, 0.08),
            chin_size: around(stream, 1.0, 0.3),
            chin_forward: around(stream, 0.0, 0.06),
            cheek_size: around(stream, 1.0, 0.2),
            cheek_height: around(stream, 0.0, 0.07),
            blush: around(stream, 0.5, 0.5),
            freckles: if stream.chance(0.22) { stream.range(0.4, 1.0) } else { 0.0 },
        }
    }
}

impl Eyes {
    fn draw(stream: &mut Stream, complexion: &palette::Complexion) -> Self {
        Self {
            size: around(stream, 0.285, 0.045),
            spacing: around(stream, 0.36, 0.03),
            height: around(stream, -0.06, 0.05),
            tilt_rad: around(stream, 0.05, 0.16),
            iris: palette::iris(stream),
            iris_rad: around(stream, 0.62, 0.07),
            pupil: around(stream, 0.46, 0.12),
            upper_lid_rad: around(stream, 0.6, 0.18),
            lower_lid_rad: around(stream, 0.56, 0.14),
            gaze_azimuth_rad: around(stream, 0.0, 0.22),
            gaze_elevation_rad: around(stream, 0.0, 0.1),
            lashes: (complexion.persona * 1.1 + 0.25 * stream.normal()).clamp(0.0, 1.0),
        }
    }
}

impl Eyebrows {
    fn draw(stream: &mut Stream, complexion: &palette::Complexion) -> Self {
        Self {
            colour: complexion.brow(stream),
            thickness: around(stream, 0.05 - 0.016 * complexion.persona, 0.016),
            length: around(stream, 0.23, 0.045),
            arch: around(stream, 0.09, 0.05),
            tilt_rad: around(stream, -0.14, 0.2),
            height: around(stream, 0.2, 0.05),
            raise: if stream.chance(0.25) { stream.range(-0.08, 0.08) } else { 0.0 },
        }
    }
}

impl Mouth {
    fn draw(stream: &mut Stream, complexion: &palette::Complexion) -> Self {
        let laughing = stream.chance(0.55);
        let made_up = stream.chance(0.7 * complexion.persona);
        let (lip_colour, tint) = if made_up { palette::lipstick(stream) } else { ([0.85, 0.36, 0.36], 0.0) };
        Self {
            width: around(stream, if laughing { 0.36 } else { 0.29 }, 0.06),
            place: around(stream, 0.43, 0.06),
            smile: if laughing { around(stream, 0.13, 0.05) } else { around(stream, 0.08, 0.07) },
            open: if laughing {
                around(stream, 0.17, 0.09)
            } else if stream.chance(0.2) {
                around(stream, 0.08, 0.04)
            } else {
                0.0
            },
            fullness: around(stream, 0.85 + 0.25 * complexion.persona, 0.35),
            lip_colour,
            tint: if made_up { tint } else { stream.range(0.1, 0.35) },
        }
    }
}

impl Nose {
    fn draw(stream: &mut Stream) -> Self {
        Self {
            length: around(stream, 0.3, 0.12),
            width: around(stream, 1.0, 0.3),
            bulb: around(stream, 0.115, 0.04),
            bridge: around(stream, 0.06, 0.025),
            forward: around(stream, 0.1, 0.07),
        }
    }
}

impl Ears {
    fn draw(stream: &mut Stream, complexion: &palette::Complexion) -> Self {
        Self {
            size: around(stream, 0.25, 0.06),
            angle_rad: around(stream, 0.5, 0.3),
            height: around(stream, -0.04, 0.06),
            point: if stream.chance(if complexion.fantastic { 0.6 } else { 0.03 }) {
                stream.range(0.5, 1.0)
            } else {
                0.0
            },
            studs: stream.chance(0.1 + 0.4 * complexion.persona),
        }
    }
}

impl Hair {
    fn draw(stream: &mut Stream, complexion: &palette::Complexion) -> Self {
        use HairStyle::{
            Afro, Bald, Beanie, Bob, Bowl, Braids, Bun, Buzz, Crop, Curly, Long, Mohawk, Pigtails, Ponytail, Quiff,
            SidePart, Spiky, Wavy,
        };
        let styles: &[HairStyle] = if stream.chance(complexion.persona) {
            &[Bob, Long, Wavy, Bun, Ponytail, Pigtails, Braids, Afro, Curly, Bob, Long, Wavy, Beanie, SidePart]
        } else {
            &[Bald, Buzz, Crop, SidePart, Quiff, Bowl, Curly, Afro, Mohawk, Spiky, Crop, SidePart, Beanie, Bun]
        };
        Self {
            style: stream.pick(styles).copied().unwrap_or(SidePart),
            colour: complexion.hair,
            accent: palette::vivid(stream),
            volume: stream.uniform(),
            length: stream.uniform(),
            hairline: around(stream, 0.0, 0.06),
            fringe: stream.chance(0.45),
            side: if stream.chance(0.5) { 1.0 } else { -1.0 },
            tousle: stream.bits(),
        }
    }
}

impl Neck {
    fn draw(stream: &mut Stream) -> Self {
        let garment = stream.pick(&Garment::ALL).copied().unwrap_or(Garment::TShirt);
        let (colour, trim) = palette::outfit(stream);
        let pattern = match stream.below(8) {
            0 | 1 => Pattern::Stripes,
            2 => Pattern::Dots,
            3 => Pattern::Raglan,
            4 => Pattern::Ribs,
            _ => Pattern::Plain,
        };
        Self { width: around(stream, 1.0, 0.14), shoulders: around(stream, 1.0, 0.12), garment, colour, trim, pattern }
    }
}

impl Background {
    fn draw(stream: &mut Stream) -> Self {
        let kind = match stream.below(10) {
            0 | 1 => BackgroundKind::Flat,
            2..5 => BackgroundKind::Gradient,
            5..8 => BackgroundKind::Bokeh,
            _ => BackgroundKind::Hills,
        };
        let [lower, upper, accent] = palette::backdrop(stream);
        Self { kind, lower, upper, accent, arrangement: stream.bits() }
    }
}
