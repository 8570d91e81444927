//! The nine regions of a portrait, their order, names, groups and colours.
//!
//! The order is fixed: label maps, code rows and network weights are all indexed by it.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};

use crate::error::Error;

/// Number of regions; the paper's k.
pub const REGION_COUNT: usize = 9;

/// A semantic region of a portrait. `region as usize` is its label value and its row in codes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[repr(u8)]
pub enum Region {
    /// Everything that is not the person.
    Background = 0,
    /// Skin of the face that no other region claims; glasses' frames and lenses count here in photos.
    Face,
    /// Eyeballs with iris and pupil, between the lids.
    Eyes,
    /// Eyebrows.
    Eyebrows,
    /// Lips and the inside of the mouth.
    Mouth,
    /// Nose.
    Nose,
    /// Ears with their ornaments.
    Ears,
    /// Hair and hats.
    Hair,
    /// Neck and clothes.
    Neck,
}

impl Region {
    /// All regions in label order.
    pub const ALL: [Self; REGION_COUNT] = [
        Self::Background,
        Self::Face,
        Self::Eyes,
        Self::Eyebrows,
        Self::Mouth,
        Self::Nose,
        Self::Ears,
        Self::Hair,
        Self::Neck,
    ];

    /// The label value: 0 for the background up to 8 for the neck.
    pub const fn index(self) -> usize {
        self as usize
    }

    /// The region of a label value, if there is one.
    pub fn from_label(label: u8) -> Option<Self> {
        Self::ALL.get(usize::from(label)).copied()
    }

    /// The name used on the command line and in files.
    pub const fn name(self) -> &'static str {
        ["background", "face", "eyes", "eyebrows", "mouth", "nose", "ears", "hair", "neck"][self as usize]
    }

    /// The sRGB colour that stands for the region in pictures of label maps.
    pub const fn colour(self) -> [u8; 3] {
        [
            [46, 46, 56],
            [236, 188, 160],
            [66, 133, 244],
            [121, 85, 72],
            [219, 68, 85],
            [245, 166, 84],
            [171, 110, 204],
            [94, 62, 48],
            [66, 170, 116],
        ][self as usize]
    }
}

impl fmt::Display for Region {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Region {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self, Error> {
        Self::ALL.into_iter().find(|region| region.name() == name).ok_or_else(|| unknown_region(name))
    }
}

/// A set of regions. Written as a comma-separated list of names and of the groups `skin` and `all`.
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct RegionSet(u16);

impl RegionSet {
    /// No region.
    pub const EMPTY: Self = Self(0);
    /// Every region.
    pub const ALL: Self = Self((1 << REGION_COUNT) - 1);
    /// Face, nose and ears.
    pub const SKIN: Self = Self(1 << Region::Face as u16 | 1 << Region::Nose as u16 | 1 << Region::Ears as u16);
    /// Every region but the background: those that live in the volume when the background is the far plane.
    pub const FOREGROUND: Self = Self(Self::ALL.0 & !1);

    /// Whether `region` is in the set.
    pub const fn contains(self, region: Region) -> bool {
        self.0 & (1 << region as u16) != 0
    }

    /// Whether the set has no region.
    pub const fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// Number of regions in the set.
    pub const fn len(self) -> usize {
        self.0.count_ones() as usize
    }

    /// The set with `region` in it.
    #[must_use]
    pub const fn with(self, region: Region) -> Self {
        Self(self.0 | 1 << region as u16)
    }

    /// The set without `region`.
    #[must_use]
    pub const fn without(self, region: Region) -> Self {
        Self(self.0 & !(1 << region as u16))
    }

    /// Regions in either set.
    #[must_use]
    pub const fn union(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// The regions in label order.
    pub fn iter(self) -> impl Iterator<Item = Region> {
        Region::ALL.into_iter().filter(move |region| self.contains(*region))
    }
}

impl From<Region> for RegionSet {
    fn from(region: Region) -> Self {
        Self::EMPTY.with(region)
    }
}

impl FromIterator<Region> for RegionSet {
    fn from_iter<I: IntoIterator<Item = Region>>(regions: I) -> Self {
        regions.into_iter().fold(Self::EMPTY, Self::with)
    }
}

impl fmt::Display for RegionSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if *self == Self::ALL {
            return f.write_str("all");
        }
        let names: Vec<_> = self.iter().map(Region::name).collect();
        f.write_str(&names.join(","))
    }
}

impl fmt::Debug for RegionSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "RegionSet({self})")
    }
}

impl FromStr for RegionSet {
    type Err = Error;

    fn from_str(list: &str) -> Result<Self, Error> {
        list.split(',').map(str::trim).filter(|name| !name.is_empty()).try_fold(Self::EMPTY, |set, name| {
            Ok(match name {
                "skin" => set.union(Self::SKIN),
                "all" => set.union(Self::ALL),
                name => set.with(name.parse()?),
            })
        })
    }
}

impl TryFrom<String> for RegionSet {
    type Error = Error;

    fn try_from(list: String) -> Result<Self, Error> {
        list.parse()
    }
}

impl From<RegionSet> for String {
    fn from(set: RegionSet) -> Self {
        set.to_string()
    }
}

fn unknown_region(name: &str) -> Error {
    let known: Vec<_> = Region::ALL.iter().map(|region| region.name()).collect();
    Error::config("region", format!("unknown region `{name}`; the regions are {}, skin and all", known.join(", ")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_labels_round_trip() {
        for (label, region) in Region::ALL.into_iter().enumerate() {
            assert_eq!(region.index(), label);
            assert_eq!(Region::from_label(label as u8), Some(region));
            assert_eq!(region.name().parse::<Region>().unwrap(), region);
        }
        assert_eq!(Region::from_label(9), None);
    }

    #[test]
    fn sets_parse_lists_and_groups() {
        let set: RegionSet = "hair, skin".parse().unwrap();
        assert_eq!(set.to_string(), "face,nose,ears,hair");
        assert_eq!("all".parse::<RegionSet>().unwrap(), RegionSet::ALL);
        assert!("hiar".parse::<RegionSet>().unwrap_err().to_string().contains("unknown region `hiar`"));
    }
}
