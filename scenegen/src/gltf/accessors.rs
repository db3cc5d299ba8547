//! Reads buffers, buffer views and accessors; every offset is checked.

use std::borrow::Cow;
use std::path::Path;

use gltf::json;
use json::accessor::{ComponentType, Type};
use json::validation::Checked;

use super::{fault, remedy};
use crate::error::Error;
use crate::resource::{Folder, data_uri};

/// Maximum number of elements of an accessor without a buffer view. Its elements start as zeros, so the file's
/// size does not bound their number.
const MAX_ZEROS: usize = 1 << 24;

/// The contents of a file's buffers, each read at its first use.
pub(super) struct Buffers<'a> {
    path: &'a Path,
    root: &'a json::Root,
    folder: Folder,
    /// The binary chunk of a `.glb` file.
    blob: Option<&'a [u8]>,
    /// The bytes of each buffer, once it has been read.
    read: Vec<Option<Cow<'a, [u8]>>>,
}

/// An accessor's elements as numbers.
pub(super) struct Floats {
    /// Number of components per element.
    size: usize,
    values: Vec<f32>,
}

impl Floats {
    pub(super) fn count(&self) -> usize {
        self.values.len() / self.size
    }

    /// Element `i`; components that the accessor lacks are 1.
    pub(super) fn get<const N: usize>(&self, i: usize) -> [f32; N] {
        let element = &self.values[i * self.size..(i + 1) * self.size];
        std::array::from_fn(|c| element.get(c).copied().unwrap_or(1.0))
    }

    /// Adds `weight` times other elements, which may have fewer components.
    pub(super) fn add(&mut self, deltas: &Self, weight: f32) {
        let deltas = deltas.values.chunks_exact(deltas.size);
        for (element, delta) in self.values.chunks_exact_mut(self.size).zip(deltas) {
            for (value, delta) in element.iter_mut().zip(delta) {
                *value += weight * delta;
            }
        }
    }
}

/// Type and number of an accessor's elements.
struct Layout {
    component: ComponentType,
    /// Number of components per element.
    size: usize,
    count: usize,
    normalised: bool,
}

impl<'a> Buffers<'a> {
    pub(super) fn new(
        path: &'a Path,
        root: &'a json::Root,
        blob: Option<&'a [u8]>,
    ) -> Result<Self, Error> {
        let folder = Folder::containing(path)?;
        Ok(Self { path, root, folder, blob, read: vec![None; root.buffers.len()] })
    }

    /// The bytes of a URI: those of a file, or embedded data.
    pub(super) fn uri(&self, element: &str, uri: &str) -> Result<Vec<u8>, Error> {
        if !uri.starts_with("data:") {
            return self.folder.read_uri(element, uri);
        }
        data_uri(uri).ok_or_else(|| fault(self.path, element, "its data URI is not base64"))
    }

    /// The bytes of a buffer view.
    pub(super) fn view(&mut self, index: usize, element: &str) -> Result<&[u8], Error> {
        let path = self.path;
        let name = format!("{element}, buffer view {index}");
        let Some(view) = self.root.buffer_views.get(index) else {
            return Err(fault(path, name, "there is no such buffer view"));
        };
        let (offset, length) = (view.byte_offset.map_or(0, |o| o.0), view.byte_length.0);
        let buffer = self.buffer(view.buffer.value(), &name)?;
        let range = usize::try_from(offset).ok().zip(usize::try_from(length).ok());
        let bytes =
            range.and_then(|(offset, length)| buffer.get(offset..offset.checked_add(length)?));
        bytes.ok_or_else(|| {
            let problem = format!("bytes {offset} to {offset} + {length} lie beyond its buffer");
            fault(path, name, problem)
        })
    }

    fn buffer(&mut self, index: usize, element: &str) -> Result<&[u8], Error> {
        let name = || format!("{element}, buffer {index}");
        let Some(buffer) = self.root.buffers.get(index) else {
            return Err(fault(self.path, name(), "there is no such buffer"));
        };
        let extensions = buffer.extensions.iter().filter(|_| buffer.uri.is_none());
        let mut compressed = extensions.flat_map(|e| e.others.keys());
        if let Some(extension) = compressed.find(|name| name.ends_with("_meshopt_compression")) {
            let feature = format!("{}: data that only {extension} defines", name());
            return Err(Error::unsupported(self.path, &feature, remedy(extension)));
        }
        if self.read[index].is_none() {
            let bytes: Cow<'a, [u8]> = match (&buffer.uri, self.blob.filter(|_| index == 0)) {
                (Some(uri), _) => self.uri(&name(), uri)?.into(),
                (None, Some(blob)) => blob.into(),
                (None, None) => {
                    let problem = "it has neither a URI nor a binary chunk";
                    return Err(fault(self.path, name(), problem));
                }
            };
            let declared = buffer.byte_length.0;
            if (bytes.len() as u64) < declared {
                let problem = format!("it should have {declared} bytes and has {}", bytes.len());
                return Err(fault(self.path, name(), problem));
            }
            self.read[index] = Some(bytes);
        }
        let whole = self.read[index].as_deref().unwrap_or_default();
        // Bytes beyond the declared length are padding.
        Ok(&whole[..usize::try_from(buffer.byte_length.0).unwrap_or(whole.len()).min(whole.len())])
    }

    /// An accessor's elements, whose number of components must be in `sizes`. Normalised integers become
    /// fractions.
    pub(super) fn floats(
        &mut self,
        index: usize,
        sizes: &[usize],
        element: &str,
    ) -> Result<Floats, Error> {
        let name = format!("{element}, accessor {index}");
        let layout = self.layout(index, &name)?;
        if !sizes.contains(&layout.size) {
            let problem = format!("it has {} components, not {}", layout.size, sizes[0]);
            return Err(fault(self.path, name, problem));
        }
        let convert = |bytes: &[u8]| number(layout.component, layout.normalised, bytes);
        let values = self.elements(index, &layout, &name, convert)?;
        Ok(Floats { size: layout.size, values })
    }

    /// An accessor's elements as vertex indices.
    pub(super) fn indices(&mut self, index: usize, element: &str) -> Result<Vec<u32>, Error> {
        let name = format!("{element} indices, accessor {index}");
        let layout = self.layout(index, &name)?;
        let unsigned =
            matches!(layout.component, ComponentType::U8 | ComponentType::U16 | ComponentType::U32);
        if layout.size != 1 || !unsigned {
            return Err(fault(self.path, name, "indices must be unsigned scalars"));
        }
        self.elements(index, &layout, &name, unsigned_integer)
    }

    fn layout(&self, index: usize, name: &str) -> Result<Layout, Error> {
        let Some(accessor) = self.root.accessors.get(index) else {
            return Err(fault(self.path, name, "there is no such accessor"));
        };
        let (Checked::Valid(component), Checked::Valid(kind)) =
            (accessor.component_type, accessor.type_)
        else {
            return Err(fault(self.path, name, "its type or componentType is unknown"));
        };
        let size = match kind {
            Type::Scalar => 1,
            Type::Vec2 => 2,
            Type::Vec3 => 3,
            Type::Vec4 => 4,
            Type::Mat4 => 16,
            Type::Mat2 | Type::Mat3 => {
                return Err(fault(self.path, name, "matrices are not vertex attributes"));
            }
        };
        let count = usize::try_from(accessor.count.0).unwrap_or(usize::MAX);
        if count == 0 {
            return Err(fault(self.path, name, "it has no elements"));
        }
        Ok(Layout { component: component.0, size, count, normalised: accessor.normalized })
    }

    /// All components of an accessor, with sparse replacements applied.
    fn elements<T: Copy + Default>(
        &mut self,
        index: usize,
        layout: &Layout,
        name: &str,
        convert: impl Fn(&[u8]) -> T,
    ) -> Result<Vec<T>, Error> {
        let (path, accessor) = (self.path, &self.root.accessors[index]);
        let width = layout.component.size();
        let mut values = match accessor.buffer_view {
            Some(view) => {
                let offset = accessor.byte_offset.map_or(0, |o| o.0);
                let stride = self.root.buffer_views.get(view.value()).and_then(|v| v.byte_stride);
                let bytes = self.view(view.value(), name)?;
                let packing = Packing { offset, stride: stride.map(|s| s.0), width };
                unpack(bytes, &packing, layout, &convert).ok_or_else(|| beyond(path, name))?
            }
            None if layout.count > MAX_ZEROS => {
                return Err(fault(path, name, "it has more than 2^24 elements and no buffer view"));
            }
            None => vec![T::default(); layout.count * layout.size],
        };
        let Some(sparse) = &accessor.sparse else {
            return Ok(values);
        };
        let Checked::Valid(component) = sparse.indices.component_type else {
            return Err(fault(path, name, "its sparse indices have an unknown componentType"));
        };
        let count = usize::try_from(sparse.count.0).unwrap_or(usize::MAX);
        let index_layout = Layout { component: component.0, size: 1, count, normalised: false };
        let view = self.view(sparse.indices.buffer_view.value(), name)?;
        let index_width = component.0.size();
        let packing =
            Packing { offset: sparse.indices.byte_offset.0, stride: None, width: index_width };
        let targets = unpack(view, &packing, &index_layout, unsigned_integer)
            .ok_or_else(|| beyond(path, name))?;
        let value_layout = Layout { count, ..*layout };
        let view = self.view(sparse.values.buffer_view.value(), name)?;
        let packing = Packing { offset: sparse.values.byte_offset.0, stride: None, width };
        let replacements =
            unpack(view, &packing, &value_layout, &convert).ok_or_else(|| beyond(path, name))?;
        for (&target, new) in targets.iter().zip(replacements.chunks_exact(layout.size)) {
            let at = target as usize * layout.size;
            let Some(old) = values.get_mut(at..at + layout.size) else {
                return Err(fault(path, name, format!("its sparse index {target} lies beyond it")));
            };
            old.copy_from_slice(new);
        }
        Ok(values)
    }
}

fn beyond(path: &Path, name: &str) -> Error {
    fault(path, name, "its elements lie beyond its buffer view")
}

/// The arrangement of elements in a buffer view `[bytes]`.
struct Packing {
    offset: u64,
    /// Distance between elements; `None` if they are contiguous.
    stride: Option<usize>,
    /// Size of a component.
    width: usize,
}

/// The components of `layout.count` elements; `None` if they lie beyond the bytes.
fn unpack<T>(
    bytes: &[u8],
    packing: &Packing,
    layout: &Layout,
    convert: impl Fn(&[u8]) -> T,
) -> Option<Vec<T>> {
    let element = layout.size * packing.width;
    let stride = packing.stride.filter(|&stride| stride > 0).unwrap_or(element);
    let bytes = bytes.get(usize::try_from(packing.offset).ok()?..)?;
    // The last element need not fill its stride.
    let needed = (layout.count.checked_sub(1)?).checked_mul(stride)?.checked_add(element)?;
    if stride < element || needed > bytes.len() {
        return None;
    }
    let mut values = Vec::with_capacity(layout.count * layout.size);
    for i in 0..layout.count {
        let element = &bytes[i * stride..i * stride + element];
        values.extend(element.chunks_exact(packing.width).map(&convert));
    }
    Some(values)
}

fn word<const N: usize>(bytes: &[u8]) -> [u8; N] {
    bytes.try_into().unwrap_or([0; N])
}

/// A component as a number. Normalised integers become fractions (glTF 2.0, 3.11).
fn number(component: ComponentType, normalised: bool, bytes: &[u8]) -> f32 {
    let (value, full) = match component {
        ComponentType::I8 => (f32::from(i8::from_le_bytes(word(bytes))), 127.0),
        ComponentType::U8 => (f32::from(u8::from_le_bytes(word(bytes))), 255.0),
        ComponentType::I16 => (f32::from(i16::from_le_bytes(word(bytes))), 32_767.0),
        ComponentType::U16 => (f32::from(u16::from_le_bytes(word(bytes))), 65_535.0),
        ComponentType::U32 => (u32::from_le_bytes(word(bytes)) as f32, 1.0),
        ComponentType::F32 => return f32::from_le_bytes(word(bytes)),
    };
    if normalised { (value / full).max(-1.0) } else { value }
}

fn unsigned_integer(bytes: &[u8]) -> u32 {
    bytes.iter().rev().fold(0, |value, &byte| value << 8 | u32::from(byte))
}
