//! Adam's two moments, as f32 or in fewer bits; see [`MomentStorage`].
//!
//! The first moment is at most 7.3 roots of the second, whatever the gradients were: what a step
//! uses is that ratio, and [`MomentStorage::Ratio8`] stores nothing else, in steps of 0.057. Noise
//! alone gives ratios of about 0.23, to whose variance the rounding adds a twentieth; it has no
//! scale that neighbours would share, and so none that a neighbour could spoil.

use std::ops::Range;

use super::blocks::{BlockTask, BlockView, Blocks, Degrees, Scratch};
use super::narrow::{Bf16, Draws, F8, Narrow, first_moment, first_moments, narrow, ratios, widen};
use super::simd::WIDTH;
use crate::backend::{MomentStorage, StateError, Tensor};

/// The moments of all rows, first and second.
#[derive(Debug)]
pub(super) enum Moments {
    /// See [`MomentStorage::F32`].
    F32([Blocks; 2]),
    /// See [`MomentStorage::Bf16`].
    Bf16([Blocks<Bf16>; 2]),
    /// See [`MomentStorage::Ratio8`].
    Ratio8(Blocks<i8>, Blocks<Bf16>),
    /// See [`MomentStorage::Both8`].
    Both8(Blocks<i8>, Blocks<F8>),
}

/// Does the same to both moments, whatever they are.
macro_rules! each_moment {
    ($moments:expr, $blocks:ident => $do:expr) => {
        match $moments {
            Moments::F32([first, second]) => each_moment!(first, second, $blocks => $do),
            Moments::Bf16([first, second]) => each_moment!(first, second, $blocks => $do),
            Moments::Ratio8(first, second) => each_moment!(first, second, $blocks => $do),
            Moments::Both8(first, second) => each_moment!(first, second, $blocks => $do),
        }
    };
    ($first:ident, $second:ident, $blocks:ident => $do:expr) => {{
        {
            let $blocks = $first;
            $do
        }
        {
            let $blocks = $second;
            $do
        }
    }};
}

impl Moments {
    pub(super) fn zeros(capacity: usize, planes: usize, storage: MomentStorage) -> Self {
        match storage {
            MomentStorage::F32 => Self::F32([0, 1].map(|_| Blocks::zeros(capacity, planes))),
            MomentStorage::Bf16 => Self::Bf16([0, 1].map(|_| Blocks::zeros(capacity, planes))),
            MomentStorage::Ratio8 => {
                Self::Ratio8(Blocks::zeros(capacity, planes), Blocks::zeros(capacity, planes))
            }
            MomentStorage::Both8 => {
                Self::Both8(Blocks::zeros(capacity, planes), Blocks::zeros(capacity, planes))
            }
        }
    }

    /// Bytes for `capacity` rows.
    pub(super) fn bytes(capacity: usize, planes: usize, storage: MomentStorage) -> u64 {
        let half = Blocks::<Bf16>::bytes(capacity, planes);
        let byte = Blocks::<F8>::bytes(capacity, planes);
        match storage {
            MomentStorage::F32 => 2 * Blocks::<f32>::bytes(capacity, planes),
            MomentStorage::Bf16 => 2 * half,
            MomentStorage::Ratio8 => byte + half,
            MomentStorage::Both8 => 2 * byte,
        }
    }

    /// Bytes that are there.
    pub(super) fn held(&self) -> u64 {
        let mut sum = 0;
        each_moment!(self, blocks => sum += blocks.held());
        sum
    }

    pub(super) fn clear_row(&mut self, row: usize) {
        each_moment!(self, blocks => blocks.clear_row(row));
    }

    /// Copies what is stored, to the bit.
    pub(super) fn copy_row(&mut self, from: usize, to: usize) {
        each_moment!(self, blocks => blocks.copy_row(from, to));
    }

    pub(super) fn swap_rows(&mut self, a: usize, b: usize) {
        each_moment!(self, blocks => blocks.swap_rows(a, b));
    }

    /// See [`Blocks::drop_bands`].
    pub(super) fn drop_bands(&mut self, rows: usize, of_model: u8, degrees: Degrees) {
        each_moment!(self, blocks => blocks.drop_bands(rows, of_model, degrees));
    }

    /// Zero moments of one parameter.
    pub(super) fn forget(&mut self, row: usize, plane: usize) {
        each_moment!(self, blocks => blocks.set(row, plane, Default::default()));
    }

    /// The first and the second moment of one parameter.
    pub(super) fn get(&self, row: usize, plane: usize) -> [f32; 2] {
        match self {
            Self::F32(both) => both.each_ref().map(|blocks| blocks.get(row, plane)),
            Self::Bf16(both) => both.each_ref().map(|blocks| blocks.get(row, plane).to_f32()),
            Self::Ratio8(first, second) => pair(first, second, row, plane),
            Self::Both8(first, second) => pair(first, second, row, plane),
        }
    }

    /// The blocks of the first `rows` rows, to read.
    pub(super) fn view(&self, rows: usize) -> MomentView<'_> {
        match self {
            Self::F32(both) => MomentView::F32(both.each_ref().map(|blocks| blocks.view(rows))),
            Self::Bf16(both) => MomentView::Bf16(both.each_ref().map(|blocks| blocks.view(rows))),
            Self::Ratio8(first, second) => MomentView::Ratio8(first.view(rows), second.view(rows)),
            Self::Both8(first, second) => MomentView::Both8(first.view(rows), second.view(rows)),
        }
    }

    /// The blocks of the first `rows` rows, cut for the optimiser's tasks.
    pub(super) fn tasks(&mut self, rows: usize) -> Vec<MomentTask<'_>> {
        match self {
            Self::F32([m, v]) => {
                let both = m.tasks(rows).into_iter().zip(v.tasks(rows));
                both.map(|(m, v)| MomentTask::F32([m, v])).collect()
            }
            Self::Bf16([m, v]) => {
                let both = m.tasks(rows).into_iter().zip(v.tasks(rows));
                both.map(|(m, v)| MomentTask::Bf16([m, v])).collect()
            }
            Self::Ratio8(m, v) => {
                let both = m.tasks(rows).into_iter().zip(v.tasks(rows));
                both.map(|(m, v)| MomentTask::Ratio8(m, v)).collect()
            }
            Self::Both8(m, v) => {
                let both = m.tasks(rows).into_iter().zip(v.tasks(rows));
                both.map(|(m, v)| MomentTask::Both8(m, v)).collect()
            }
        }
    }

    /// The first (0) or second (1) moments of some rows, as they are stored: numbers, the bits of
    /// shorter ones, or ratios in two's complement. Shape: `[rows.len(), planes]`.
    pub(super) fn tensor(
        &self,
        which: usize,
        name: &str,
        rows: Range<usize>,
        planes: usize,
    ) -> Tensor {
        let shape = [rows.len(), planes];
        let halves = |blocks: &Blocks<Bf16>| {
            let bits = blocks.to_rows(rows.clone(), 0..planes).into_iter().map(|x| x.0).collect();
            Tensor::u16(name, &shape, bits)
        };
        match (self, which) {
            (Self::F32(both), _) => Tensor::f32(name, &shape, both[which].to_rows(rows, 0..planes)),
            (Self::Bf16(both), _) => halves(&both[which]),
            (Self::Ratio8(first, _) | Self::Both8(first, _), 0) => {
                let ratios = first.to_rows(rows, 0..planes);
                Tensor::u8(name, &shape, ratios.into_iter().map(i8::cast_unsigned).collect())
            }
            (Self::Ratio8(_, second), _) => halves(second),
            (Self::Both8(_, second), _) => {
                let bits = second.to_rows(rows, 0..planes).into_iter().map(|x| x.0).collect();
                Tensor::u8(name, &shape, bits)
            }
        }
    }

    /// Takes back what [`tensor`](Self::tensor) returned.
    pub(super) fn restore(
        &mut self,
        which: usize,
        rows: Range<usize>,
        planes: usize,
        tensor: Tensor,
    ) -> Result<(), StateError> {
        let shape = [rows.len(), planes];
        let halves = |blocks: &mut Blocks<Bf16>, tensor: Tensor| {
            let bits: Vec<Bf16> = tensor.into_u16(&shape)?.into_iter().map(Bf16).collect();
            blocks.set_rows(rows.clone(), 0..planes, &bits);
            Ok(())
        };
        match (self, which) {
            (Self::F32(both), _) => {
                both[which].set_rows(rows, 0..planes, &tensor.into_f32(&shape)?);
                Ok(())
            }
            (Self::Bf16(both), _) => halves(&mut both[which], tensor),
            (Self::Ratio8(first, _) | Self::Both8(first, _), 0) => {
                let ratios = tensor.into_u8(&shape)?.into_iter().map(u8::cast_signed);
                first.set_rows(rows, 0..planes, &ratios.collect::<Vec<i8>>());
                Ok(())
            }
            (Self::Ratio8(_, second), _) => halves(second, tensor),
            (Self::Both8(_, second), _) => {
                let bits: Vec<F8> = tensor.into_u8(&shape)?.into_iter().map(F8).collect();
                second.set_rows(rows, 0..planes, &bits);
                Ok(())
            }
        }
    }
}

/// Both moments of one parameter, of which the first is stored as a ratio.
fn pair<T: Narrow>(first: &Blocks<i8>, second: &Blocks<T>, row: usize, plane: usize) -> [f32; 2] {
    let second = second.get(row, plane).to_f32();
    [first_moment(first.get(row, plane), second), second]
}

/// The same of the first `used` numbers of a block.
#[inline(always)]
fn open_pair<T: Narrow>(first: &[i8], second: &[T], used: usize, [m, v]: [&mut Scratch; 2]) {
    let (m, v) = (&mut m.0[..used], &mut v.0[..used]);
    widen(&second[..used], v);
    first_moments(&first[..used], v, m);
}

/// Stores the first `used` numbers of both moments of a block; the first as a multiple of what is
/// stored of the second.
#[inline(always)]
fn close_pair<T: Narrow>(
    [m, v]: &[Scratch; 2],
    used: usize,
    first: &mut [i8],
    second: &mut [T],
    [of_m, of_v]: [&mut Draws; 2],
) {
    let second = &mut second[..used];
    narrow(&v.0[..used], second, of_v);
    ratios(&m.0[..used], second, &mut first[..used], of_m);
}

/// The moments of some blocks, to read.
#[derive(Debug, Clone, Copy)]
pub(super) enum MomentView<'a> {
    F32([BlockView<'a, f32>; 2]),
    Bf16([BlockView<'a, Bf16>; 2]),
    Ratio8(BlockView<'a, i8>, BlockView<'a, Bf16>),
    Both8(BlockView<'a, i8>, BlockView<'a, F8>),
}

impl<'a> MomentView<'a> {
    /// The first `planes` planes, or more, of a block that holds as many, of both moments.
    pub(super) fn open<'b>(
        self,
        block: usize,
        planes: usize,
        scratch: &'b mut [Scratch; 2],
    ) -> [&'b [f32]; 2]
    where
        'a: 'b,
    {
        let used = planes * WIDTH;
        let [m, v] = scratch;
        match self {
            Self::F32(both) => return both.map(|blocks| blocks.block(block)),
            Self::Bf16([first, second]) => {
                widen(&first.block(block)[..used], &mut m.0[..used]);
                widen(&second.block(block)[..used], &mut v.0[..used]);
            }
            Self::Ratio8(first, second) => {
                open_pair(first.block(block), second.block(block), used, [m, v]);
            }
            Self::Both8(first, second) => {
                open_pair(first.block(block), second.block(block), used, [m, v]);
            }
        }
        [&m.0, &v.0]
    }
}

/// The moments of some blocks, to change.
#[derive(Debug)]
pub(super) enum MomentTask<'a> {
    F32([BlockTask<'a, f32>; 2]),
    Bf16([BlockTask<'a, Bf16>; 2]),
    Ratio8(BlockTask<'a, i8>, BlockTask<'a, Bf16>),
    Both8(BlockTask<'a, i8>, BlockTask<'a, F8>),
}

impl MomentTask<'_> {
    /// The first `planes` planes, or more, of a block that holds as many, of both moments.
    #[inline(always)]
    pub(super) fn open<'b>(
        &'b mut self,
        block: usize,
        planes: usize,
        scratch: &'b mut [Scratch; 2],
    ) -> [&'b mut [f32]; 2] {
        let used = planes * WIDTH;
        let [m, v] = scratch;
        match self {
            Self::F32([first, second]) => return [first.block(block), second.block(block)],
            Self::Bf16([first, second]) => {
                widen(&first.block(block)[..used], &mut m.0[..used]);
                widen(&second.block(block)[..used], &mut v.0[..used]);
            }
            Self::Ratio8(first, second) => {
                open_pair(first.block(block), second.block(block), used, [m, v]);
            }
            Self::Both8(first, second) => {
                open_pair(first.block(block), second.block(block), used, [m, v]);
            }
        }
        [&mut m.0, &mut v.0]
    }

    /// Stores the planes that were opened, where they are not what is stored.
    #[inline(always)]
    pub(super) fn close(
        &mut self,
        block: usize,
        planes: usize,
        scratch: &[Scratch; 2],
        draws: [&mut Draws; 2],
    ) {
        let used = planes * WIDTH;
        let ([m, v], [of_m, of_v]) = (scratch, draws);
        match self {
            Self::F32(_) => {}
            Self::Bf16([first, second]) => {
                narrow(&m.0[..used], &mut first.block(block)[..used], of_m);
                narrow(&v.0[..used], &mut second.block(block)[..used], of_v);
            }
            Self::Ratio8(first, second) => {
                let (first, second) = (first.block(block), second.block(block));
                close_pair(scratch, used, first, second, [of_m, of_v]);
            }
            Self::Both8(first, second) => {
                let (first, second) = (first.block(block), second.block(block));
                close_pair(scratch, used, first, second, [of_m, of_v]);
            }
        }
    }

    /// Whether what is stored is not what was computed.
    #[inline(always)]
    pub(super) fn is_narrow(&self) -> bool {
        !matches!(self, Self::F32(_))
    }
}
