//! Properties of a Gaussian: x y z, f_dc_0..2, f_rest_* channel by channel, opacity (logit), scale_0..2 (logarithms),
//! rot_0..3 (w x y z); all f32, or x y z in f64.

use crate::ply::Element;
use densify_core::gaussians::{MAX_SH_DEGREE, sh_coefficients};

/// First bytes of every PLY file.
pub(in crate::models) const START: &[u8] = b"ply";

/// Names of the properties that are read, in the order of the original trainer, which also writes three normals, all 0,
/// before index [`NORMALS_AT`].
pub(super) fn properties(sh_degree: u8) -> impl Iterator<Item = String> {
    let rest = 3 * (sh_coefficients(sh_degree) - 1);
    let named = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect::<Vec<_>>();
    let numbered =
        |prefix: &str, count: usize| (0..count).map(|i| format!("{prefix}{i}")).collect::<Vec<_>>();
    [
        named(&["x", "y", "z"]),
        numbered("f_dc_", 3),
        numbered("f_rest_", rest),
        named(&["opacity"]),
        numbered("scale_", 3),
        numbered("rot_", 4),
    ]
    .into_iter()
    .flatten()
}

/// Start of the comment that states the offset of local coordinates as three numbers: a position in the dataset's
/// coordinates is (x, y, z) plus the offset.
pub(crate) const OFFSET: &str = "densify offset";
/// Start of the comment that states a point near the model, if x, y and z are `double`. Measured from there, positions
/// are exact in f32.
pub(super) const NEAR: &str = "densify near";

/// The property that holds the radius of Mip-Splatting's 3D filter `[scene units]`.
pub(super) const FILTER: &str = "filter_3D";

/// Number of [`properties`] before the normals.
pub(super) const NORMALS_AT: usize = 3;

/// The degree with as many coefficients above band 0 as an element has `f_rest_*` properties.
///
/// # Errors
/// The number of properties, if no degree has that many.
pub(in crate::models) fn sh_degree(element: &Element) -> Result<u8, usize> {
    let rest = element.properties.iter().filter(|p| p.name.starts_with("f_rest_")).count();
    let fits = |degree: &u8| 3 * (sh_coefficients(*degree) - 1) == rest;
    (0..=MAX_SH_DEGREE).find(fits).ok_or(rest)
}
