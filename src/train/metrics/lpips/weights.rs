//! Reads the weights: a safetensors file with the arrays of the published package `lpips`.

use std::io::Read;
use std::path::{Path, PathBuf};

use safetensors::SafeTensors;
use safetensors::tensor::Dtype;

use super::Lpips;
use super::convolution::Convolution;
use super::network::{Layer, Network, Stage};
use densify_core::files;

/// Size of the largest accepted file of weights `[bytes]`; VGG-16 takes 59 MB.
const MAX_BYTES: u64 = 256 << 20;
/// Remedy for unsuitable files.
const REMEDY: &str = "create it as described in docs/metrics.md";

/// Reason why weights cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum LpipsError {
    /// The file cannot be read.
    #[error("{}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// The file does not contain the expected weights.
    #[error("{}: {problem}; {REMEDY}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// What is wrong with the file.
        problem: String,
    },
}

impl Lpips {
    /// Reads the weights of VGG-16 or AlexNet, whichever the file contains.
    ///
    /// # Errors
    /// When the file cannot be read, is longer than 256 MiB, is not a safetensors file, or does not contain all arrays
    /// of one of the networks, with the names and shapes of the package `lpips` and finite 32-bit floats.
    pub fn open(path: &Path) -> Result<Self, LpipsError> {
        let read = |source| LpipsError::Read { path: path.to_owned(), source };
        let mut bytes = Vec::new();
        let file = files::open(path).map_err(read)?;
        file.take(MAX_BYTES + 1).read_to_end(&mut bytes).map_err(read)?;
        Self::from_bytes(&bytes)
            .map_err(|problem| LpipsError::Malformed { path: path.to_owned(), problem })
    }

    pub(super) fn from_bytes(bytes: &[u8]) -> Result<Self, String> {
        if bytes.len() as u64 > MAX_BYTES {
            return Err(format!("it is longer than {MAX_BYTES} bytes"));
        }
        let file = SafeTensors::deserialize(bytes)
            .map_err(|e| format!("it is not a safetensors file ({e})"))?;
        let has = |name: &str| file.names().contains(&name);
        let network = if has("net.slice1.2.weight") {
            Network::Vgg
        } else if has("net.slice2.3.weight") {
            Network::Alex
        } else {
            return Err("it contains neither VGG-16 nor AlexNet".to_owned());
        };
        let stages = network.stages().into_iter().enumerate().map(|(stage, layers)| {
            let convolutions = layers.iter().map(|layer| convolution(&file, stage, layer));
            let convolutions: Vec<_> = convolutions.collect::<Result<_, String>>()?;
            let channels = convolutions.last().map_or(0, |last| last.channels[1]);
            let weights =
                array(&file, &format!("lin{stage}.model.1.weight"), &[1, channels, 1, 1])?;
            Ok(Stage { convolutions, weights, pooling: network.pooling(stage) })
        });
        let stages = stages.collect::<Result<_, String>>()?;
        Ok(Self { network, stages })
    }
}

/// Reads a convolution of a stage.
fn convolution(
    file: &SafeTensors<'_>,
    stage: usize,
    &(number, channels, side, stride, padding): &Layer,
) -> Result<Convolution, String> {
    let name = format!("net.slice{}.{number}", stage + 1);
    let shape = [channels[1], channels[0], side, side];
    let weights = array(file, &format!("{name}.weight"), &shape)?;
    let bias = array(file, &format!("{name}.bias"), &channels[1..])?;
    Ok(Convolution::new(channels, (side, stride, padding), &weights, bias))
}

/// Reads an array of 32-bit floats, and checks its shape and that all values are finite.
fn array(file: &SafeTensors<'_>, name: &str, shape: &[usize]) -> Result<Vec<f32>, String> {
    let tensor = file.tensor(name).map_err(|_| format!("`{name}` is missing"))?;
    if tensor.dtype() != Dtype::F32 || tensor.shape() != shape {
        let (kind, actual) = (tensor.dtype(), tensor.shape());
        return Err(format!("`{name}` is {kind:?} {actual:?} instead of F32 {shape:?}"));
    }
    let values = tensor.data().as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes));
    let values: Vec<f32> = values.collect();
    if values.iter().any(|value| !value.is_finite()) {
        return Err(format!("`{name}` has non-finite values"));
    }
    Ok(values)
}
