//! The one table of the device's arrays with an entry per row: name, width, line of the ledger, and
//! what becomes of it when rows are edited, saved and audited.

use std::ops::Range;

use crate::NumberKind;
use densify_core::gaussians::ModelArray;
use densify_core::memory::Section;

/// Buffers of the geometry, then of the four colour bands.
pub(super) type PartNames = [&'static str; 5];
pub(super) const PARAMETERS: PartNames = ["rows", "sh0", "sh1", "sh2", "sh3"];
pub(super) const FIRST: PartNames =
    ["first rows", "first sh0", "first sh1", "first sh2", "first sh3"];
pub(super) const SECOND: PartNames =
    ["second rows", "second sh0", "second sh1", "second sh2", "second sh3"];
pub(super) const WAITING: PartNames =
    ["waiting rows", "waiting sh0", "waiting sh1", "waiting sh2", "waiting sh3"];

/// Numbers per row of the geometry, the last of which is padding.
const GEOMETRY: usize = 12;
/// Numbers per row of the gradients; see `shaders/project_bwd.wgsl`.
pub(super) const GRADIENT: usize = 20;

/// What an array holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Holds {
    Geometry,
    Colour,
    FirstMoments,
    SecondMoments,
    /// Gradients that wait for an optimiser step.
    Waiting,
    /// Steps of the optimiser, as whole numbers.
    Ages,
    /// Accumulated signals, one plane of rows after another.
    Signals,
    /// What projection and tile lists know of a row in the view at hand.
    Projected,
    /// Logits of masks, counted from where they began, so that 0 is a fresh one.
    Masks,
    MaskMoments,
    /// Pixels that a row dominates in the view at hand.
    Dominated,
    /// Gradients of splats, summed over the view at hand.
    SplatGradients,
    /// Gradients by parameters in the view at hand.
    RowGradients,
}

/// What an edit does to an array.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Edited {
    /// A newborn row's numbers follow from its parent's and the plan; moved rows take theirs along.
    Computed,
    /// A newborn row gets a copy of its parent's numbers; moved rows take theirs along.
    Inherited,
    /// A newborn row starts at 0; moved rows take theirs along.
    Cleared,
    /// Nothing: it is written anew for each view.
    Untouched,
}

/// What follows from what an array holds.
#[derive(Debug, Clone, Copy)]
pub(super) struct Traits {
    pub(super) section: Section,
    /// Line of the ledger.
    pub(super) line: &'static str,
    pub(super) edited: Edited,
    /// Saved in checkpoints as this array; parameters are saved as the model, signals one by one.
    pub(super) is_saved: bool,
    /// Searched for numbers that are not finite.
    pub(super) audited: Option<NumberKind>,
    /// Needed by training only, so that frozen rows have no place in it.
    pub(super) is_for_training: bool,
}

impl Holds {
    pub(super) const fn traits(self) -> Traits {
        use Edited::{Cleared, Computed, Inherited, Untouched};
        let (section, line, edited, is_saved, audited) = match self {
            Self::Geometry => {
                (Section::Model, "parameters", Computed, false, Some(NumberKind::Parameter))
            }
            Self::Colour => {
                (Section::Model, "parameters", Inherited, false, Some(NumberKind::Parameter))
            }
            Self::FirstMoments | Self::SecondMoments => {
                (Section::Model, "optimiser moments", Cleared, true, Some(NumberKind::Moment))
            }
            Self::Waiting => {
                (Section::Gradients, "gradients summed between steps", Cleared, true, None)
            }
            Self::Ages => (Section::Model, "optimiser ages and bias tables", Cleared, true, None),
            Self::Signals => (Section::Policy, "signals", Cleared, false, None),
            Self::Projected => (Section::Renderer, "projected splats", Untouched, false, None),
            Self::Masks => (Section::Policy, "masks", Inherited, true, None),
            Self::MaskMoments => (Section::Policy, "masks", Cleared, true, None),
            Self::Dominated => (Section::Policy, "dominated pixels", Untouched, false, None),
            Self::SplatGradients => (Section::Gradients, "splat gradients", Untouched, false, None),
            Self::RowGradients => (Section::Gradients, "row gradients", Untouched, false, None),
        };
        let is_for_training =
            matches!(edited, Cleared) || matches!(self, Self::Masks | Self::RowGradients);
        Traits { section, line, edited, is_saved, audited, is_for_training }
    }
}

/// One array.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct RowArray {
    /// Name of the buffer.
    pub(super) name: &'static str,
    /// Numbers per row, of four bytes each.
    pub(super) numbers: usize,
    pub(super) holds: Holds,
    /// The parameters of a row that the numbers belong to, one by one; empty where they belong to none.
    pub(super) parameters: Range<usize>,
}

impl RowArray {
    /// Bytes per row.
    pub(super) fn row_bytes(&self) -> u64 {
        4 * self.numbers as u64
    }

    /// How far apart rows lie, and the numbers of a row, where the array has so many rows.
    pub(super) fn pitch(&self, rows: u64) -> [u32; 2] {
        match self.holds {
            Holds::Signals => [1, rows as u32],
            _ => [self.numbers as u32, 1],
        }
    }
}

/// Every array of a model of this degree; `waits`: whether gradients of the geometry and of band 0,
/// and those of bands 1–3, may wait for a step; planes of signals, fields of a record, counts of pixels
/// that a row dominates, and masks.
pub(super) fn row_arrays(
    sh_degree: u8,
    waits: [bool; 2],
    [planes, fields, counts, masks]: [usize; 4],
) -> Vec<RowArray> {
    let geometry = 0..ModelArray::Sh.parameters(sh_degree).start;
    let band = |band: usize| {
        let coefficient = |k: usize| geometry.end + 3 * k * k;
        coefficient(band)..coefficient(band + 1)
    };
    let mut all = Vec::new();
    for (of_geometry, of_colour, names) in [
        (Holds::Geometry, Holds::Colour, PARAMETERS),
        (Holds::FirstMoments, Holds::FirstMoments, FIRST),
        (Holds::SecondMoments, Holds::SecondMoments, SECOND),
        (Holds::Waiting, Holds::Waiting, WAITING),
    ] {
        for (part, name) in names.into_iter().enumerate().take(usize::from(sh_degree) + 2) {
            let array = match part {
                0 => (GEOMETRY, of_geometry, geometry.clone()),
                _ => (band(part - 1).len(), of_colour, band(part - 1)),
            };
            let (numbers, holds, parameters) = array;
            if holds != Holds::Waiting || waits[usize::from(part > 1)] {
                all.push(RowArray { name, numbers, holds, parameters });
            }
        }
    }
    let others = [
        ("ages", 1, Holds::Ages),
        ("signals", planes, Holds::Signals),
        ("splats", 12, Holds::Projected),
        ("footprints", 4, Holds::Projected),
        ("depths", 1, Holds::Projected),
        ("order", 1, Holds::Projected),
        ("slots of row", 2, Holds::Projected),
        ("row sums", fields, Holds::SplatGradients),
        ("gradient", GRADIENT, Holds::RowGradients),
        ("dominant", counts, Holds::Dominated),
        ("mask offsets", masks, Holds::Masks),
        ("mask moments", 2 * masks, Holds::MaskMoments),
    ];
    let unlike_parameters =
        |(name, numbers, holds)| RowArray { name, numbers, holds, parameters: 0..0 };
    all.extend(others.map(unlike_parameters));
    all
}

/// Most bytes per row of any one array of a model of this degree, whatever the policy needs.
pub(super) fn widest_row(sh_degree: u8) -> u64 {
    let arrays = row_arrays(sh_degree, [false; 2], [0; 4]);
    arrays.iter().map(RowArray::row_bytes).max().unwrap_or(0)
}
