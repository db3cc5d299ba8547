//! A cache of decoded images with a size limit, filled ahead of use by background threads.
//!
//! Training visits every view once per epoch, in a new order each time, and announces the views that it needs next. Of
//! the others, the most recently used one will on average be needed latest, so its image is evicted first.
//! (Least-recently-used eviction would almost always miss once the images do not all fit.)

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use super::LoadError;
use super::images::{ImageSource, SharedImage};
use densify_core::image::depth::SharedDepth;

/// A decoded image, with the depth of its view.
#[derive(Debug, Clone)]
pub struct Loaded {
    /// The image.
    pub image: SharedImage,
    /// Its depth, if it is used and known.
    pub depth: Option<SharedDepth>,
}

/// Decodes images on demand. Caching affects waiting times only, never pixels.
#[derive(Debug)]
pub struct ImageCache {
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

#[derive(Debug)]
struct Shared {
    sources: Vec<ImageSource>,
    capacity: u64,
    state: Mutex<State>,
    /// Signalled when an image has been queued, memory has become available, or the threads must end.
    work: Condvar,
    /// Signalled when an image has been loaded.
    loaded: Condvar,
}

#[derive(Debug, Default)]
struct State {
    slots: Vec<Slot>,
    /// Announced images that are not being loaded yet.
    queue: VecDeque<usize>,
    /// Size of the images that are cached or being loaded `[bytes]`.
    bytes: u64,
    /// Number of accesses so far.
    clock: u64,
    end: bool,
}

#[derive(Debug, Default)]
struct Slot {
    content: Content,
    /// True if the image has been announced and not been fetched since.
    is_announced: bool,
    /// Value of the clock at the last use.
    used: u64,
}

#[derive(Debug, Default)]
enum Content {
    #[default]
    Empty,
    Loading,
    Ready(Loaded),
    Failed(LoadError),
}

impl ImageCache {
    /// A cache of at most `cache_bytes` of decoded images, or of two images if that is more. `threads` background
    /// threads decode the images announced by [`Self::prefetch`]; with 0 threads, all images are decoded on demand.
    pub(crate) fn new(sources: Vec<ImageSource>, cache_bytes: u64, threads: usize) -> Self {
        let capacity = ImageDemand::total(sources.iter()).capacity(cache_bytes);
        let slots = sources.iter().map(|_| Slot::default()).collect();
        let state = Mutex::new(State { slots, ..State::default() });
        let shared = Arc::new(Shared {
            sources,
            capacity,
            state,
            work: Condvar::new(),
            loaded: Condvar::new(),
        });
        let threads = (0..threads)
            .map_while(|index| {
                let shared = Arc::clone(&shared);
                // If the thread cannot be started, images are decoded on demand.
                std::thread::Builder::new()
                    .name(format!("prefetch-{index}"))
                    .spawn(move || shared.serve())
                    .ok()
            })
            .collect();
        Self { shared, threads }
    }

    /// Announces the images needed next, in order, instead of those announced before.
    pub fn prefetch(&self, upcoming: &[usize]) {
        let mut state = self.shared.lock();
        state.queue.clear();
        for slot in &mut state.slots {
            slot.is_announced = false;
        }
        for &index in upcoming {
            let Some(slot) = state.slots.get_mut(index) else {
                continue;
            };
            let first = !std::mem::replace(&mut slot.is_announced, true);
            if first && matches!(slot.content, Content::Empty) && !self.threads.is_empty() {
                state.queue.push_back(index);
            }
        }
        drop(state);
        self.shared.work.notify_all();
    }

    /// The image of source `index`; see [`get_with_depth`](Self::get_with_depth).
    ///
    /// # Errors
    /// As [`get_with_depth`](Self::get_with_depth).
    ///
    /// # Panics
    /// When there is no such source.
    pub fn get(&self, index: usize) -> Result<SharedImage, LoadError> {
        self.get_with_depth(index).map(|loaded| loaded.image)
    }

    /// The image and the depth of source `index`; decodes them, or waits until a background thread has decoded it.
    ///
    /// # Errors
    /// When the file cannot be loaded. The next call tries again.
    ///
    /// # Panics
    /// When there is no such source.
    pub fn get_with_depth(&self, index: usize) -> Result<Loaded, LoadError> {
        let source = &self.shared.sources[index];
        let mut state = self.shared.lock();
        state.slots[index].is_announced = false;
        loop {
            state.clock += 1;
            let clock = state.clock;
            let slot = &mut state.slots[index];
            slot.used = clock;
            match std::mem::take(&mut slot.content) {
                Content::Ready(loaded) => {
                    slot.content = Content::Ready(loaded.clone());
                    // The image may now be evicted, which a thread may be waiting for.
                    self.shared.work.notify_all();
                    return Ok(loaded);
                }
                Content::Failed(error) => return Err(error),
                Content::Loading => {
                    slot.content = Content::Loading;
                    state = self.shared.loaded.wait(state).unwrap_or_else(PoisonError::into_inner);
                }
                Content::Empty => break,
            }
        }
        state.queue.retain(|&queued| queued != index);
        let cached = state.make_room(&self.shared, index);
        if cached {
            state.slots[index].content = Content::Loading;
        }
        drop(state);
        let result = load(source);
        if cached {
            let mut state = self.shared.lock();
            state.finish(&self.shared, index, result.clone());
            if result.is_err() {
                // The caller gets the error and may try again.
                state.slots[index].content = Content::Empty;
            }
            drop(state);
            self.shared.loaded.notify_all();
            self.shared.work.notify_all();
        }
        result
    }
}

impl Drop for ImageCache {
    fn drop(&mut self) {
        self.shared.lock().end = true;
        self.shared.work.notify_all();
        for thread in self.threads.drain(..) {
            // Panics of decoders are caught inside the thread.
            let _ = thread.join();
        }
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The loop of a background thread.
    fn serve(&self) {
        let mut state = self.lock();
        while !state.end {
            let next = state.queue.front().copied();
            let Some(index) = next.filter(|&index| state.make_room(self, index)) else {
                state = self.work.wait(state).unwrap_or_else(PoisonError::into_inner);
                continue;
            };
            state.queue.pop_front();
            state.slots[index].content = Content::Loading;
            drop(state);
            let result = load(&self.sources[index]);
            state = self.lock();
            state.finish(self, index, result);
            self.loaded.notify_all();
        }
    }
}

impl State {
    /// Reserves memory for an image by evicting the most recently used images that are not announced. Returns false if
    /// that is not enough.
    fn make_room(&mut self, shared: &Shared, index: usize) -> bool {
        let needed = shared.sources[index].loaded_bytes();
        while self.bytes + needed > shared.capacity {
            let victim = (self.slots.iter().enumerate())
                .filter(|(i, slot)| {
                    *i != index && !slot.is_announced && matches!(slot.content, Content::Ready(_))
                })
                .max_by_key(|(_, slot)| slot.used)
                .map(|(i, _)| i);
            let Some(victim) = victim else { return false };
            self.slots[victim].content = Content::Empty;
            self.bytes -= shared.sources[victim].loaded_bytes();
        }
        self.bytes += needed;
        true
    }

    /// Stores the result of loading an image for which [`Self::make_room`] reserved memory.
    fn finish(&mut self, shared: &Shared, index: usize, result: Result<Loaded, LoadError>) {
        if result.is_err() {
            self.bytes -= shared.sources[index].loaded_bytes();
        }
        self.slots[index].content = match result {
            Ok(loaded) => Content::Ready(loaded),
            Err(error) => Content::Failed(error),
        };
    }
}

/// Memory needed by a set of images.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageDemand {
    /// All decoded images together `[bytes]`.
    pub all: u64,
    /// The largest decoded image `[bytes]`.
    pub largest: u64,
    /// Largest memory for loading an image, in addition to the decoded image `[bytes]`.
    pub working: u64,
}

impl ImageDemand {
    /// The memory that these images need.
    pub fn total<'a>(sources: impl Iterator<Item = &'a ImageSource>) -> Self {
        sources.fold(Self { all: 0, largest: 0, working: 0 }, |sum, source| {
            let loaded = source.loaded_bytes();
            Self {
                all: sum.all.saturating_add(loaded),
                largest: sum.largest.max(loaded),
                working: sum.working.max(source.working_bytes().saturating_sub(loaded)),
            }
        })
    }

    /// Peak memory of decoded images with a cache of `cache_bytes`, including one image that is in use
    /// but no longer cached `[bytes]`.
    pub fn held(&self, cache_bytes: u64) -> u64 {
        self.all.min(self.capacity(cache_bytes).saturating_add(self.largest))
    }

    /// Peak memory for decoding: one image per thread, and one on demand `[bytes]`.
    pub fn decoding(&self, threads: usize) -> u64 {
        (threads as u64 + 1) * self.working + self.largest
    }

    fn capacity(&self, cache_bytes: u64) -> u64 {
        cache_bytes.max(2 * self.largest)
    }
}

/// Loads an image with its depth, turning a panic of the decoder into an error.
fn load(source: &ImageSource) -> Result<Loaded, LoadError> {
    let load = || {
        let image = Arc::new(source.load()?);
        Ok(Loaded { image, depth: source.load_depth()? })
    };
    catch_unwind(AssertUnwindSafe(load))
        .unwrap_or_else(|_| Err(LoadError::image(&source.file.path, "the decoder failed")))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `count` images of 16x16 px with different colours, 768 bytes each.
    fn sources(folder: &std::path::Path, count: u8) -> Vec<ImageSource> {
        (0..count)
            .map(|i| {
                let path = folder.join(format!("{i}.png"));
                image::RgbImage::from_pixel(16, 16, [i, 0, 0].into()).save(&path).unwrap();
                ImageSource::whole(path)
            })
            .collect()
    }

    fn held(cache: &ImageCache) -> Vec<usize> {
        let state = cache.shared.lock();
        let ready = |i: &usize| matches!(state.slots[*i].content, Content::Ready(_));
        (0..state.slots.len()).filter(ready).collect()
    }

    #[test]
    fn images_are_right_whatever_is_announced() {
        let folder = tempfile::tempdir().unwrap();
        let sources = sources(folder.path(), 9);
        for (bytes, threads) in [(0, 0), (0, 2), (3 * 768, 1), (3 * 768, 3), (1 << 20, 2)] {
            let cache = ImageCache::new(sources.clone(), bytes, threads);
            let order: Vec<usize> = (0..60).map(|i| (i * 5 + i / 9) % 9).collect();
            for (at, &index) in order.iter().enumerate() {
                cache.prefetch(&order[at..order.len().min(at + 4)]);
                assert_eq!(cache.get(index).unwrap().rgb[0], index as u8);
                let state = cache.shared.lock();
                assert!(state.bytes <= cache.shared.capacity, "{} bytes", state.bytes);
            }
        }
    }

    #[test]
    fn cyclic_access_hits_the_cache_even_if_not_all_images_fit() {
        let folder = tempfile::tempdir().unwrap();
        let cache = ImageCache::new(sources(folder.path(), 6), 4 * 768, 0);
        let mut hits = 0;
        for round in 0..10 {
            for index in 0..6 {
                hits += usize::from(round > 0 && held(&cache).contains(&index));
                cache.get(index).unwrap();
            }
        }
        // Of the 54 accesses after the first round, at least half hit; none would with least-recently-used eviction.
        assert!(hits >= 27, "{hits}");
        assert_eq!(held(&cache).len(), 4);
    }

    #[test]
    fn announced_images_are_decoded_ahead_and_stay_cached() {
        let folder = tempfile::tempdir().unwrap();
        let cache = ImageCache::new(sources(folder.path(), 6), 3 * 768, 2);
        cache.prefetch(&[4, 2, 5, 1]);
        let mut state = cache.shared.lock();
        while state.slots.iter().filter(|slot| matches!(slot.content, Content::Ready(_))).count()
            < 3
        {
            state = cache.shared.loaded.wait(state).unwrap();
        }
        drop(state);
        assert_eq!(held(&cache), [2, 4, 5]);
        // There is no room beside the announced images: the image is returned but not cached.
        assert_eq!(cache.get(0).unwrap().rgb[0], 0);
        assert_eq!(held(&cache), [2, 4, 5]);
        assert_eq!(cache.get(4).unwrap().rgb[0], 4);
        assert_eq!(cache.get(1).unwrap().rgb[0], 1);
    }

    #[test]
    fn get_returns_the_error_of_a_background_thread_with_the_file_name() {
        let folder = tempfile::tempdir().unwrap();
        let sources = sources(folder.path(), 3);
        let bytes = std::fs::read(&sources[1].file.path).unwrap();
        std::fs::write(&sources[1].file.path, &bytes[..bytes.len() / 2]).unwrap();
        let cache = ImageCache::new(sources, 1 << 20, 1);
        cache.prefetch(&[1, 2]);
        let _ = cache.get(2);
        for _ in 0..3 {
            let message = cache.get(1).unwrap_err().to_string();
            assert!(message.contains("1.png"), "{message}");
        }
        assert_eq!(cache.get(0).unwrap().rgb[0], 0);
        let state = cache.shared.lock();
        assert_eq!(state.bytes, 2 * 768, "the failed image's memory is free again");
    }

    #[test]
    fn dropping_ends_the_threads_even_with_a_full_queue() {
        let folder = tempfile::tempdir().unwrap();
        let cache = ImageCache::new(sources(folder.path(), 9), 0, 2);
        cache.prefetch(&[0, 1, 2, 3, 4, 5, 6, 7, 8]);
        let shared = Arc::downgrade(&cache.shared);
        drop(cache);
        assert_eq!(shared.strong_count(), 0);
    }

    #[test]
    fn the_demand_covers_cached_images_and_one_in_use() {
        let folder = tempfile::tempdir().unwrap();
        let demand = |count| ImageDemand::total(sources(folder.path(), count).iter());
        assert_eq!(demand(4).held(1 << 30), 4 * 768, "all images, not the cache's size");
        assert_eq!(demand(9).held(3 * 768), 4 * 768);
        assert_eq!(demand(9).held(0), 3 * 768, "two in the cache, one in use");
        assert!(demand(9).decoding(1) >= 2 * 768);
        assert_eq!(demand(0), ImageDemand { all: 0, largest: 0, working: 0 });
    }
}
