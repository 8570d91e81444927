//! What is known of a chunk's samples: regions' raw values where a shape branch ran, and heads where a texture branch
//! did. A frame fills it from nothing; after an edit the frame starts from what the edit left true.

use crate::{
    error::Result,
    kernels::PreparedRegion,
    render::plan::{local::Ready, rays::Rays},
};

/// No slot.
const NONE: u32 = u32::MAX;

/// One region's heads at the samples where they are known.
#[derive(Clone, Default)]
pub struct HeadStore {
    /// Per sample, where its values lie among `values`.
    slots: Vec<u32>,
    /// One point's C values after another's; behind the last that is known, what was known before.
    values: Vec<f32>,
    count: usize,
}

impl HeadStore {
    /// Forgets everything.
    pub fn clear(&mut self) {
        self.slots.fill(NONE);
        self.count = 0;
    }

    /// Evaluates those of `samples` that are not known yet; returns how many.
    pub fn fill(
        &mut self,
        region: &dyn PreparedRegion<f32>,
        rays: &Rays,
        samples: &[u32],
        inputs: &mut Vec<f32>,
    ) -> Result<usize> {
        if self.slots.is_empty() {
            self.slots = vec![NONE; rays.depths.len()];
        }
        let columns = region.shape().point_columns();
        inputs.clear();
        let before = self.count;
        for sample in samples {
            let slot = &mut self.slots[*sample as usize];
            if *slot == NONE {
                *slot = self.count as u32;
                self.count += 1;
                rays.push_input(*sample as usize, columns, inputs);
            }
        }
        let width = region.rows().count;
        if self.values.len() < self.count * width {
            self.values.resize(self.count * width, 0.0);
        }
        region.forward(inputs, &mut self.values[before * width..self.count * width])?;
        Ok(self.count - before)
    }

    /// The values at a sample that was filled.
    pub fn at(&self, sample: u32, width: usize) -> &[f32] {
        &self.values[self.slots[sample as usize] as usize * width..][..width]
    }
}

/// A chunk's samples.
#[derive(Clone, Default)]
pub struct ChunkState {
    /// Raw mask and residual of each region, `[n S, k, 2]`.
    pub raw: Vec<f32>,
    /// The initial network's distance, `[n S]`, if the field has one.
    pub initial: Vec<f32>,
    /// Per sample the regions whose raw values are known, as bits; the initial network's is [`INITIAL_BIT`].
    pub known: Vec<u16>,
    /// Per region.
    pub heads: Vec<HeadStore>,
}

/// The initial network among the regions' bits.
pub const INITIAL_BIT: u16 = 1 << 15;

impl ChunkState {
    /// Room for `samples` samples, nothing known.
    pub fn new(field: &Ready, samples: usize) -> Self {
        let regions = field.regions.len();
        Self {
            raw: vec![0.0; samples * regions * 2],
            initial: if field.initial.is_some() { vec![0.0; samples] } else { Vec::new() },
            known: vec![0; samples],
            heads: vec![HeadStore::default(); regions],
        }
    }

    /// What it holds, bytes.
    pub fn memory(&self) -> usize {
        let heads = self.heads.iter().map(|store| store.slots.len() + store.values.len()).sum::<usize>();
        size_of::<f32>() * (self.raw.len() + self.initial.len() + heads) + size_of::<u16>() * self.known.len()
    }

    /// Forgets everything.
    pub fn forget(&mut self) {
        self.known.fill(0);
        self.heads.iter_mut().for_each(HeadStore::clear);
    }

    /// Runs every region whole at `samples`: shape branches, and texture branches with all that the heads give.
    pub fn fill_heads(&mut self, field: &Ready, rays: &Rays, samples: &[u32], room: &mut Room) -> Result<()> {
        let regions = field.regions.len();
        for (region, (store, heads)) in self.heads.iter_mut().zip(&field.heads).enumerate() {
            store.fill(heads.as_ref(), rays, samples, &mut room.inputs)?;
            let rows = heads.rows();
            for sample in samples {
                let values = store.at(*sample, rows.count);
                let raw = [values[rows.mask], values[rows.residual]];
                let sample = *sample as usize;
                self.raw[(sample * regions + region) * 2..][..2].copy_from_slice(&raw);
                self.known[sample] |= 1 << region;
            }
        }
        // Every region is known by now: this runs the initial network alone.
        self.fill_shapes(field, rays, samples, |_| 0, room)?;
        Ok(())
    }

    /// Forgets what depends on a region's shape.
    pub fn forget_shape(&mut self, bit: u16) {
        self.known.iter_mut().for_each(|known| *known &= !bit);
    }

    /// Runs the shape branches of the regions `wanted` (bits per sample, in the order of `samples`) where they are not
    /// known yet; returns how many (sample, region) pairs that were.
    pub fn fill_shapes(
        &mut self,
        field: &Ready,
        rays: &Rays,
        samples: &[u32],
        wanted: impl Fn(usize) -> u16,
        room: &mut Room,
    ) -> Result<usize> {
        let mut pairs = 0;
        for region in 0..field.regions.len() {
            let places = samples.iter().enumerate().filter(|(place, _)| wanted(*place) & 1 << region != 0);
            pairs += self.fill_one(field, rays, places.map(|(_, sample)| *sample), region, room)?;
        }
        if let Some(initial) = &field.initial {
            room.start();
            for sample in samples.iter().filter(|sample| self.known[**sample as usize] & INITIAL_BIT == 0) {
                room.samples.push(*sample);
                rays.push_input(*sample as usize, initial.shape().point_columns(), &mut room.inputs);
            }
            let rows = initial.rows();
            room.values.resize(rows.count * room.samples.len(), 0.0);
            initial.forward(&room.inputs, &mut room.values)?;
            for (sample, values) in room.samples.iter().zip(room.values.chunks_exact(rows.count)) {
                self.initial[*sample as usize] = values[rows.residual];
                self.known[*sample as usize] |= INITIAL_BIT;
            }
        }
        Ok(pairs)
    }

    /// Runs one region's shape branch at those of `samples` where it is not known yet; returns how many that were.
    pub fn fill_shape(
        &mut self,
        field: &Ready,
        rays: &Rays,
        samples: &[u32],
        region: usize,
        room: &mut Room,
    ) -> Result<usize> {
        self.fill_one(field, rays, samples.iter().copied(), region, room)
    }

    fn fill_one(
        &mut self,
        field: &Ready,
        rays: &Rays,
        samples: impl Iterator<Item = u32>,
        region: usize,
        room: &mut Room,
    ) -> Result<usize> {
        let (regions, columns, bit) = (field.regions.len(), field.columns(), 1u16 << region);
        room.start();
        for sample in samples.filter(|sample| self.known[*sample as usize] & bit == 0) {
            room.samples.push(sample);
            rays.push_input(sample as usize, columns, &mut room.inputs);
        }
        room.values.resize(2 * room.samples.len(), 0.0);
        field.shape[region].forward(&room.inputs, &mut room.values)?;
        for (sample, values) in room.samples.iter().zip(room.values.chunks_exact(2)) {
            let sample = *sample as usize;
            self.raw[(sample * regions + region) * 2..][..2].copy_from_slice(values);
            self.known[sample] |= bit;
        }
        Ok(room.samples.len())
    }
}

/// Lists in use, kept to save allocations.
#[derive(Default)]
pub struct Room {
    pub samples: Vec<u32>,
    pub inputs: Vec<f32>,
    pub values: Vec<f32>,
}

impl Room {
    fn start(&mut self) {
        self.samples.clear();
        self.inputs.clear();
        self.values.clear();
    }
}
