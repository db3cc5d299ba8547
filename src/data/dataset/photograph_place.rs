//! Where a view's pixels lie in its photograph, and which views were taken by the same camera.

use glam::DVec2;

use super::View;
use super::undistort::Undistortion;
use densify_core::vignette::PhotographPlace;

/// Largest ratio between the focal lengths of neighbours in a camera's list. Reconstructions that estimate a focal
/// length for each photograph differ by less, and two settings of a zoom usually by more.
const SAME_FOCAL: f64 = 1.1;

impl View {
    /// Where the view's pixels lie in its photograph, as the file was read: before undistortion, shrinking and
    /// cropping. `None` for one of several views of a photograph, in which the photograph's radius is not a distance.
    ///
    /// For an undistorted view, the middle is exact, and so is the size of a pixel there; towards the borders, radii
    /// differ by the distortion of the lens.
    pub fn place_in_photograph(&self) -> Option<PhotographPlace> {
        let header = self.source.header;
        let size = DVec2::new(f64::from(header.width), f64::from(header.height));
        let (whole, middle, pixel) = match &self.source.undistortion {
            None => (size, 0.5 * size, DVec2::ONE),
            Some(undistortion) => {
                let (middle, pixel) = undistorted_middle(undistortion, size)?;
                let to = undistortion.to;
                (DVec2::new(f64::from(to.width), f64::from(to.height)), middle, pixel)
            }
        };
        let loaded = DVec2::new(f64::from(self.source.width), f64::from(self.source.height));
        let corner = self
            .source
            .window
            .map_or(DVec2::ZERO, |window| DVec2::new(f64::from(window.x), f64::from(window.y)));
        let middle = middle * loaded / whole - corner;
        let pixel = pixel * whole / loaded / size.max_element();
        Some(PhotographPlace {
            middle: middle.as_vec2().to_array(),
            pixel: pixel.as_vec2().to_array(),
        })
    }

    /// The mean focal length as a share of the photograph's longer side.
    fn relative_focal(&self) -> f64 {
        let header = self.source.header;
        let size = DVec2::new(f64::from(header.width), f64::from(header.height));
        let focal = match &self.source.undistortion {
            Some(undistortion) => undistortion.from.focal,
            None => {
                let loaded =
                    DVec2::new(f64::from(self.source.width), f64::from(self.source.height));
                DVec2::new(self.camera.fx, self.camera.fy) * size / loaded
            }
        };
        0.5 * (focal.x + focal.y) / size.max_element()
    }
}

/// The place of the photograph's middle in the pinhole's image, and the size of a pixel there, in pixels of the
/// photograph.
fn undistorted_middle(undistortion: &Undistortion, size: DVec2) -> Option<(DVec2, DVec2)> {
    if undistortion.lens_from_pinhole != glam::DMat3::IDENTITY {
        return None;
    }
    let ray = undistortion.from.unproject(0.5 * size).ok()?;
    let to = undistortion.to;
    let middle = ray.truncate() / ray.z * to.focal + to.principal;
    let source = |offset: DVec2| undistortion.source_of(middle + offset);
    let step = |axis: DVec2| Some((source(axis)? - source(-axis)?).length() * 0.5);
    let pixel = DVec2::new(step(DVec2::X)?, step(DVec2::Y)?);
    (middle.is_finite() && pixel.is_finite() && pixel.min_element() > 0.0)
        .then_some((middle, pixel))
}

/// The number of each view's camera, counted from 0 in the order of the views. Views share a camera if their
/// photographs have the same size, upright or on their side, and about the same focal length. The cameras of a
/// reconstruction do not tell: many programs list one for each photograph.
pub fn cameras_of(views: &[View]) -> Vec<u32> {
    let size = |view: &View| {
        let header = view.source.header;
        (header.width.max(header.height), header.width.min(header.height))
    };
    let mut order: Vec<usize> = (0..views.len()).collect();
    let focal = |view: usize| views[view].relative_focal();
    order.sort_by(|&a, &b| {
        size(&views[a]).cmp(&size(&views[b])).then(focal(a).total_cmp(&focal(b))).then(a.cmp(&b))
    });
    let mut groups = vec![0_usize; views.len()];
    let mut group = 0;
    for pair in order.windows(2) {
        let [before, after] = [pair[0], pair[1]];
        let is_same = size(&views[before]) == size(&views[after])
            && focal(after) <= SAME_FOCAL * focal(before);
        group += usize::from(!is_same);
        groups[after] = group;
    }
    // Renumbered by first use.
    let mut numbers = vec![None; group + 1];
    let mut count = 0;
    groups
        .into_iter()
        .map(|group| {
            *numbers[group].get_or_insert_with(|| {
                count += 1;
                count - 1
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::images::ImageSource;
    use crate::dataset::window::Part;
    use densify_core::camera::Camera;
    use densify_core::image::Image8;
    use glam::{DMat3, DVec3};

    /// A view of a photograph of this size, shrunk to a half.
    fn view(width: u32, height: u32, focal: f64) -> View {
        let image = Image8::black(width, height);
        let loaded = (width / 2, height / 2);
        let camera =
            Camera::centred(loaded, (0.5 * focal, 0.5 * focal), DMat3::IDENTITY, DVec3::ZERO);
        View {
            name: "made".into(),
            camera,
            source: ImageSource::rendered("made".into(), image, loaded),
        }
    }

    #[test]
    fn radii_do_not_depend_on_resolution_or_windows() {
        let whole = view(200, 100, 150.0);
        let place = whole.place_in_photograph().unwrap();
        assert_eq!((place.middle, place.pixel), ([50.0, 25.0], [0.01, 0.01]));
        let part = Part { left: 0.5, top: 0.0, right: 1.0, bottom: 1.0 };
        let cut = whole.clone().windowed(&part);
        let x0 = cut.source.window.unwrap().x as f32;
        let inside = cut.place_in_photograph().unwrap();
        let [a, b] = [place.squared_radius(x0 + 3.0, 7.0), inside.squared_radius(3.0, 7.0)];
        assert!((a - b).abs() < 1e-6, "{a} {b}");
    }

    #[test]
    fn cameras_are_told_apart_by_size_and_focal_length() {
        let views: Vec<View> = [
            (200, 100, 150.0),
            (100, 200, 155.0),
            (200, 120, 150.0),
            (200, 100, 300.0),
            (200, 100, 160.0),
        ]
        .map(|(width, height, focal)| view(width, height, focal))
        .into();
        assert_eq!(cameras_of(&views), [0, 0, 1, 2, 0]);
    }
}
