//! The table of the device's arrays with an entry per row: name, width, line of the ledger, and how edits, checkpoints
//! and the audit treat each array.

use std::ops::Range;

use crate::NumberKind;
use crate::cpu::{MEANS, narrowed, widened};
use crate::signals::RecordLayout;
use densify_core::gaussians::ModelArray;
use densify_core::memory::Section;

/// Names of the buffers of the geometry and of the four SH bands.
type PartNames = [&'static str; 5];
pub(super) const PARAMETERS: PartNames = ["rows", "sh0", "sh1", "sh2", "sh3"];
pub(super) const FIRST: PartNames =
    ["first rows", "first sh0", "first sh1", "first sh2", "first sh3"];
pub(super) const SECOND: PartNames =
    ["second rows", "second sh0", "second sh1", "second sh2", "second sh3"];
/// Formats of the numbers.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Narrow {
    /// Both moments of a number take two bytes.
    pub(super) moments: bool,
    /// Parameters but means take 16 bits.
    pub(super) parameters: bool,
}

/// Both moments, if they are stored in bytes.
pub(super) const MOMENTS: PartNames =
    ["moments rows", "moments sh0", "moments sh1", "moments sh2", "moments sh3"];
pub(super) const WAITING: PartNames =
    ["waiting rows", "waiting sh0", "waiting sh1", "waiting sh2", "waiting sh3"];

/// Numbers per row of the geometry; the last is padding.
const GEOMETRY: usize = 12;
/// Words per row of the geometry if all but the means take 16 bits.
const NARROW_GEOMETRY: usize = 7;

/// Numbers per splat, and the index of its depth; see `shaders/shared/splat.wgsl`.
pub(super) const SPLAT: usize = 10;
pub(super) const DEPTH: usize = 9;

/// The content of an array.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Content {
    Geometry,
    Colour,
    FirstMoments,
    SecondMoments,
    /// Both moments of a number in two bytes; see `shaders/shared/moments_both8.wgsl`.
    NarrowMoments,
    /// Gradients waiting for an optimiser step.
    Waiting,
    /// Number of optimiser steps, as whole numbers.
    Ages,
    /// Accumulated signals, one plane of rows after another.
    Signals,
    /// Projection and tile lists of the current view.
    Projected,
    /// Logits of masks, relative to the initial one.
    Masks,
    MaskMoments,
    /// Number of pixels that a row dominates in the current view.
    Dominated,
    /// Gradients of splats, summed over the current view.
    SplatGradients,
}

/// The effect of an edit on an array. Moved rows keep their numbers, except in [untouched](Self::Untouched) arrays.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Edited {
    /// New rows are computed from their parent's numbers and the plan.
    Computed,
    /// New rows copy their parent's numbers.
    Inherited,
    /// New rows start at 0.
    Cleared,
    /// None: the array is rewritten for each view.
    Untouched,
}

/// Properties that follow from the content of an array.
#[derive(Debug, Clone, Copy)]
pub(super) struct Traits {
    pub(super) section: Section,
    /// Line of the ledger.
    pub(super) line: &'static str,
    pub(super) edited: Edited,
    /// True if checkpoints save the array under its name; parameters are saved as the model, and signals one by one.
    pub(super) is_saved: bool,
    /// The kind of its numbers, if the audit searches it for numbers that are not finite.
    pub(super) audited: Option<NumberKind>,
    /// True if only training uses the array, which then does not store frozen rows.
    pub(super) is_for_training: bool,
}

impl Content {
    pub(super) const fn traits(self) -> Traits {
        use Edited::{Cleared, Computed, Inherited, Untouched};
        let (section, line, edited, is_saved, audited) = match self {
            Self::Geometry => {
                (Section::Model, "parameters", Computed, false, Some(NumberKind::Parameter))
            }
            Self::Colour => {
                (Section::Model, "parameters", Inherited, false, Some(NumberKind::Parameter))
            }
            Self::FirstMoments | Self::SecondMoments | Self::NarrowMoments => {
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
        };
        let is_for_training = matches!(edited, Cleared) || matches!(self, Self::Masks);
        Traits { section, line, edited, is_saved, audited, is_for_training }
    }
}

/// An array with an entry per row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct RowArray {
    /// Name of the buffer.
    pub(super) name: &'static str,
    /// Numbers per row, of four bytes each; words, if the numbers are narrower.
    pub(super) numbers: usize,
    pub(super) content: Content,
    /// The parameters that the numbers belong to; empty if they belong to none.
    pub(super) parameters: Range<usize>,
    /// True for parameters in 16 bits.
    pub(super) is_narrow: bool,
}

impl RowArray {
    /// Bytes per row.
    pub(super) fn row_bytes(&self) -> u64 {
        4 * self.numbers as u64
    }

    /// Number of parameters per row that are stored as f32; the others take 16 bits.
    fn wide(&self) -> usize {
        match self.content {
            _ if !self.is_narrow => self.parameters.len(),
            Content::Geometry => MEANS,
            _ => 0,
        }
    }

    /// The words of rows, from all of the array's parameters of each.
    pub(super) fn words_of(&self, parameters: &[f32]) -> Vec<u32> {
        let rows = parameters.chunks_exact(self.parameters.len());
        let mut words = Vec::with_capacity(rows.len() * self.numbers);
        for row in rows {
            let end = words.len() + self.numbers;
            let (wide, narrow) = row.split_at(self.wide());
            words.extend(wide.iter().map(|x| x.to_bits()));
            let first = self.parameters.start + wide.len();
            let code = |i: usize| narrow.get(i).map_or(0, |&x| narrowed(first + i, x));
            let pairs = (0..narrow.len()).step_by(2);
            words.extend(pairs.map(|i| u32::from(code(i)) | u32::from(code(i + 1)) << 16));
            words.resize(end, 0);
        }
        words
    }

    /// The inverse of [`words_of`](Self::words_of).
    pub(super) fn parameters_of(&self, words: &[u32]) -> Vec<f32> {
        let (wide, count) = (self.wide(), self.parameters.len());
        let first = self.parameters.start + wide;
        let rows = words.chunks_exact(self.numbers);
        let mut parameters = Vec::with_capacity(rows.len() * count);
        for row in rows {
            let code = |i: usize| (row[wide + i / 2] >> (16 * (i % 2))) as u16;
            parameters.extend(row[..wide].iter().map(|&bits| f32::from_bits(bits)));
            parameters.extend((0..count - wide).map(|i| widened(first + i, code(i))));
        }
        parameters
    }

    /// Distance between rows, and between the numbers of a row, in an array of this number of rows.
    pub(super) fn pitch(&self, rows: u64) -> [u32; 2] {
        match self.content {
            Content::Signals => [1, rows as u32],
            _ => [self.numbers as u32, 1],
        }
    }
}

/// All arrays for models of this SH degree. `may_wait`: gradients of the geometry and band 0, and those of bands 1–3,
/// may wait for a step. The last argument has the numbers per row of slots, signals, records, dominated pixels and
/// masks.
pub(super) fn row_arrays(
    sh_degree: u8,
    may_wait: [bool; 2],
    narrow: Narrow,
    [slots, planes, fields, counts, masks]: [usize; 5],
) -> Vec<RowArray> {
    let geometry = 0..ModelArray::Sh.parameters(sh_degree).start;
    let band = |band: usize| {
        let coefficient = |k: usize| geometry.end + 3 * k * k;
        coefficient(band)..coefficient(band + 1)
    };
    let mut all = Vec::new();
    for (geometry_content, colour_content, names) in [
        (Content::Geometry, Content::Colour, PARAMETERS),
        (Content::FirstMoments, Content::FirstMoments, FIRST),
        (Content::SecondMoments, Content::SecondMoments, SECOND),
        (Content::NarrowMoments, Content::NarrowMoments, MOMENTS),
        (Content::Waiting, Content::Waiting, WAITING),
    ] {
        for (part, name) in names.into_iter().enumerate().take(usize::from(sh_degree) + 2) {
            let array = match part {
                0 => (GEOMETRY, geometry_content, geometry.clone()),
                _ => (band(part - 1).len(), colour_content, band(part - 1)),
            };
            let (numbers, content, parameters) = array;
            let is_narrow =
                narrow.parameters && matches!(content, Content::Geometry | Content::Colour);
            let (is_used, numbers) = match content {
                Content::Waiting => (may_wait[usize::from(part > 1)], numbers),
                Content::FirstMoments | Content::SecondMoments => (!narrow.moments, numbers),
                Content::NarrowMoments => (narrow.moments, numbers.div_ceil(2)),
                Content::Geometry if is_narrow => (true, NARROW_GEOMETRY),
                Content::Colour if is_narrow => (true, numbers.div_ceil(2)),
                _ => (true, numbers),
            };
            if is_used {
                all.push(RowArray { name, numbers, content, parameters, is_narrow });
            }
        }
    }
    let others = [
        ("ages", 1, Content::Ages),
        ("signals", planes, Content::Signals),
        ("splats", SPLAT, Content::Projected),
        ("footprints", 2, Content::Projected),
        ("order", 1, Content::Projected),
        ("slots of row", slots, Content::Projected),
        ("row sums", fields, Content::SplatGradients),
        ("dominant", counts, Content::Dominated),
        ("mask offsets", masks, Content::Masks),
        ("mask moments", 2 * masks, Content::MaskMoments),
    ];
    let without_parameters = |(name, numbers, content)| RowArray {
        name,
        numbers,
        content,
        parameters: 0..0,
        is_narrow: false,
    };
    all.extend(others.map(without_parameters));
    all
}

/// Bytes per row of the widest array for models of this SH degree, for any policy.
pub(super) fn widest_row(sh_degree: u8) -> u64 {
    let arrays = row_arrays(sh_degree, [false; 2], Narrow::default(), [0; 5]);
    let sums = 4 * RecordLayout::MOST as u64;
    arrays.iter().map(RowArray::row_bytes).fold(sums, u64::max)
}
