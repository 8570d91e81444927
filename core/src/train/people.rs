//! Who is seen in the pictures of a training set, and so which picture is shown by which code: views of one head share a
//! code, which is what teaches its depth; a mirror image is another head.

use candle_core::Tensor;

use crate::{
    data::{dataset::Dataset, loader::Draw},
    error::Result,
    rng::Stream,
};

/// The people of a set, each a row of the codes: first everyone as stored, then everyone mirrored.
#[derive(Clone, Debug)]
pub struct People {
    views: Vec<Vec<usize>>,
    person_of: Vec<usize>,
    mirror: bool,
}

impl People {
    /// The people of `dataset`, see [`Dataset::people`]; with `mirror`, their mirror images too.
    pub fn of(dataset: &Dataset, mirror: bool) -> Self {
        let views = dataset.people();
        let mut person_of = vec![0; dataset.len()];
        for (person, items) in views.iter().enumerate() {
            items.iter().for_each(|item| person_of[*item] = person);
        }
        Self { views, person_of, mirror }
    }

    /// Rows of the codes.
    pub fn count(&self) -> usize {
        self.views.len() * if self.mirror { 2 } else { 1 }
    }

    /// Every picture as stored, then every mirrored one.
    pub fn pictures(&self) -> Vec<Draw> {
        let items = self.person_of.len();
        let plain = (0..items).map(|index| Draw { index, mirrored: false });
        let mirrored = (0..if self.mirror { items } else { 0 }).map(|index| Draw { index, mirrored: true });
        plain.chain(mirrored).collect()
    }

    /// The place of a picture among [`Self::pictures`].
    pub fn place(&self, picture: Draw) -> usize {
        picture.index + if picture.mirrored { self.person_of.len() } else { 0 }
    }

    /// The row of the person on a picture.
    pub fn row(&self, picture: Draw) -> usize {
        self.person_of[picture.index] + if picture.mirrored { self.views.len() } else { 0 }
    }

    /// Means `[count, F]` over the views of every person of rows `[pictures, F]`.
    pub fn mean_of_views(&self, pictures: &Tensor) -> Result<Tensor> {
        if self.views.len() == self.person_of.len() {
            return Ok(pictures.clone());
        }
        let places = |row: usize| -> Vec<u32> {
            let mirrored = row >= self.views.len();
            let views = self.views[row % self.views.len()].iter();
            views.map(|item| self.place(Draw { index: *item, mirrored }) as u32).collect()
        };
        let mean = |row| pictures.index_select(&Tensor::new(places(row), pictures.device())?, 0)?.mean(0);
        Ok(Tensor::stack(&(0..self.count()).map(mean).collect::<candle_core::Result<Vec<_>>>()?, 0)?)
    }

    /// The first view of the person of a row.
    pub fn first_view(&self, row: usize) -> Draw {
        let person = row % self.views.len();
        Draw { index: self.views[person][0], mirrored: row >= self.views.len() }
    }

    /// One of that person's views. Where there is but one, nothing is drawn.
    pub fn view(&self, row: usize, random: &mut Stream) -> Draw {
        let views = &self.views[row % self.views.len()];
        let view = if views.len() > 1 { random.below(views.len()) } else { 0 };
        Draw { index: views[view], mirrored: row >= self.views.len() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_share_a_row_and_mirror_images_have_their_own() {
        let people = People { views: vec![vec![0, 2], vec![1]], person_of: vec![0, 1, 0], mirror: true };
        assert_eq!((people.count(), people.pictures().len()), (4, 6));
        let rows: Vec<usize> = people.pictures().into_iter().map(|picture| people.row(picture)).collect();
        assert_eq!(rows, [0, 1, 0, 2, 3, 2]);
        let places: Vec<usize> = people.pictures().into_iter().map(|picture| people.place(picture)).collect();
        assert_eq!(places, [0, 1, 2, 3, 4, 5]);
        let numbers = Tensor::arange(0f32, 6.0, &candle_core::Device::Cpu).unwrap().reshape((6, 1)).unwrap();
        let means = people.mean_of_views(&numbers).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(means, [1.0, 1.0, 4.0, 4.0]);
        let mut random = Stream::new(1, &[]);
        let seen: std::collections::BTreeSet<usize> = (0..40).map(|_| people.view(2, &mut random).index).collect();
        assert_eq!(seen, [0, 2].into());
        assert_eq!(people.first_view(3), Draw { index: 1, mirrored: true });
    }
}
