//! Animated WebP, lossless: still pictures by the `image` crate in the container of RFC 9649.

use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::Path;

use image::codecs::webp::WebPEncoder;
use image::{ExtendedColorType, RgbImage};

use densify_core::files::{FileError, write_atomically};

/// Maximum side of a WebP picture `[px]`.
pub(crate) const MAX_SIDE: u32 = 16_383;
/// Bytes before the chunks of a still picture: `RIFF`, a length, `WEBP`.
const HEAD: usize = 12;
/// Flag of the extended header that marks an animation.
const ANIMATED: u8 = 2;
/// Flag of a frame that replaces the previous one without blending.
const REPLACES: u8 = 2;

/// An animation that is being written. Its frames are kept in a temporary file.
pub(crate) struct Animation {
    size: (u32, u32),
    milliseconds: u32,
    frames: File,
}

impl Animation {
    /// An animation of this size, at most [`MAX_SIDE`] each way, with this many milliseconds per frame.
    pub(crate) fn new(size: (u32, u32), milliseconds: u32) -> io::Result<Self> {
        Ok(Self { size, milliseconds, frames: tempfile::tempfile()? })
    }

    /// Adds a frame of this animation's size.
    pub(crate) fn add(&mut self, frame: &RgbImage) -> io::Result<()> {
        assert_eq!(frame.dimensions(), self.size, "frames have one size");
        let mut still = Vec::new();
        WebPEncoder::new_lossless(&mut still)
            .encode(frame, frame.width(), frame.height(), ExtendedColorType::Rgb8)
            .map_err(io::Error::other)?;
        let picture = chunk_of(&still, b"VP8L")
            .ok_or_else(|| io::Error::other("the WebP encoder wrote no lossless picture"))?;
        let mut head = Vec::new();
        // Position, size and duration of the frame.
        for number in [0, 0, self.size.0 - 1, self.size.1 - 1, self.milliseconds.min(0x00ff_ffff)] {
            head.extend(&number.to_le_bytes()[..3]);
        }
        head.push(REPLACES);
        self.frames.write_all(b"ANMF")?;
        self.frames.write_all(&((head.len() + picture.len()) as u32).to_le_bytes())?;
        self.frames.write_all(&head)?;
        self.frames.write_all(picture)
    }

    /// Writes the file.
    pub(crate) fn write(mut self, path: &Path) -> Result<(), FileError> {
        write_atomically(path, |out| {
            let frames = self.frames.stream_position()?;
            let mut head = Vec::new();
            head.extend(b"WEBP");
            head.extend(b"VP8X");
            head.extend(10_u32.to_le_bytes());
            head.extend([ANIMATED, 0, 0, 0]);
            for side in [self.size.0, self.size.1] {
                head.extend(&(side - 1).to_le_bytes()[..3]);
            }
            head.extend(b"ANIM");
            head.extend(6_u32.to_le_bytes());
            // A black background; the animation repeats for ever.
            head.extend([0, 0, 0, 255, 0, 0]);
            let length = u32::try_from(head.len() as u64 + frames).map_err(|_| {
                io::Error::other(
                    "an animation of over 4 GiB cannot be a WebP file; use fewer frames",
                )
            })?;
            out.write_all(b"RIFF")?;
            out.write_all(&length.to_le_bytes())?;
            out.write_all(&head)?;
            self.frames.seek(SeekFrom::Start(0))?;
            io::copy(&mut self.frames, out)?;
            Ok(())
        })
    }
}

/// The chunk of this name in a still picture, with its header and padding.
fn chunk_of<'a>(still: &'a [u8], name: &[u8; 4]) -> Option<&'a [u8]> {
    let mut rest = still.get(HEAD..)?;
    loop {
        let length = u32::from_le_bytes(rest.get(4..8)?.try_into().ok()?) as usize;
        let whole = 8 + length.next_multiple_of(2);
        let chunk = rest.get(..whole)?;
        if chunk.starts_with(name) {
            return Some(chunk);
        }
        rest = &rest[whole..];
    }
}

#[cfg(test)]
mod tests {
    use image::codecs::webp::WebPDecoder;
    use image::{AnimationDecoder, Rgb};

    use super::*;

    #[test]
    fn frames_are_read_back_as_they_were() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.webp");
        let frames: Vec<RgbImage> = (0..3_u8)
            .map(|n| RgbImage::from_fn(19, 7, |x, y| Rgb([(x * 9) as u8, n * 90, (y * 30) as u8])))
            .collect();
        let mut animation = Animation::new((19, 7), 40).unwrap();
        frames.iter().for_each(|frame| animation.add(frame).unwrap());
        animation.write(&path).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        assert_eq!(u32::from_le_bytes(bytes[4..8].try_into().unwrap()) as usize, bytes.len() - 8);
        let decoder = WebPDecoder::new(io::Cursor::new(bytes)).unwrap();
        let decoded = decoder.into_frames().collect_frames().unwrap();
        assert_eq!(decoded.len(), 3);
        for (decoded, frame) in decoded.iter().zip(&frames) {
            assert_eq!(decoded.delay().numer_denom_ms(), (40, 1));
            let rgb = image::DynamicImage::from(decoded.buffer().clone()).into_rgb8();
            assert!(rgb == *frame);
        }
    }
}
