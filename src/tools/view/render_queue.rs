//! Picture requests on their way to the thread that owns the models. Only the newest request of each pane is kept. The
//! model thread renders, the encoder thread encodes, and the number of jobs in progress is limited.

use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use super::encoder::EncodedPicture;
use super::picture_request::PictureRequest;
use super::render::RenderedPicture;

/// The reason why a request got no picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum RenderError {
    /// The same pane has sent a newer request.
    Superseded,
    /// Rendering or encoding failed, with this message.
    Failed(String),
    /// Too many requests are waiting.
    QueueFull,
    /// The queue is closed.
    Closed,
}

/// A request, and the channel for its picture.
#[derive(Debug)]
pub(super) struct Job {
    pub(super) request: PictureRequest,
    reply: SyncSender<Result<EncodedPicture, RenderError>>,
}

impl Job {
    fn reply(self, result: Result<EncodedPicture, RenderError>) {
        // The connection may be closed already.
        let _ = self.reply.send(result);
    }
}

#[derive(Debug, Default)]
struct Jobs {
    /// In order of arrival.
    waiting: Vec<Job>,
    /// Rendered, but not encoded yet.
    rendered: Vec<(Job, RenderedPicture)>,
    /// Number of jobs taken but not answered yet.
    active: usize,
    is_closed: bool,
}

/// The queue between connections, model thread and encoder thread.
#[derive(Debug)]
pub(super) struct RenderQueue {
    jobs: Mutex<Jobs>,
    changed: Condvar,
    /// Maximum number of waiting requests; unlimited if `None`, as every connection has at most one.
    capacity: Option<usize>,
    /// Maximum number of jobs taken but not answered yet.
    max_active: usize,
}

impl RenderQueue {
    /// An empty queue with these limits on waiting and active jobs.
    pub(super) fn new(capacity: Option<usize>, max_active: usize) -> Self {
        Self { jobs: Mutex::default(), changed: Condvar::new(), capacity, max_active }
    }

    fn lock(&self) -> MutexGuard<'_, Jobs> {
        // A panicking holder cannot leave a change half done, so a poisoned lock is still valid.
        self.jobs.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Queues a request and waits for its picture.
    pub(super) fn submit(&self, request: PictureRequest) -> Result<EncodedPicture, RenderError> {
        let (reply, result) = sync_channel(1);
        let newest = Job { request, reply };
        {
            let mut jobs = self.lock();
            if jobs.is_closed {
                return Err(RenderError::Closed);
            }
            let pane = &newest.request.pane;
            // A newer request inherits the place of the older one; at the end of the queue it could starve.
            match jobs.waiting.iter().position(|older| older.request.pane == *pane) {
                None if self.capacity.is_some_and(|capacity| jobs.waiting.len() >= capacity) => {
                    return Err(RenderError::QueueFull);
                }
                None => jobs.waiting.push(newest),
                Some(place) => {
                    let older = std::mem::replace(&mut jobs.waiting[place], newest);
                    older.reply(Err(RenderError::Superseded));
                }
            }
        }
        self.changed.notify_all();
        result.recv().unwrap_or(Err(RenderError::Closed))
    }

    /// The next job, if one is waiting and the limit allows it.
    fn take(&self, jobs: &mut Jobs) -> Option<Job> {
        if jobs.waiting.is_empty() || jobs.active >= self.max_active {
            return None;
        }
        jobs.active += 1;
        Some(jobs.waiting.remove(0))
    }

    /// Waits until `take` returns something; `None` once the queue is closed.
    fn wait_for<T>(&self, take: impl Fn(&mut Jobs) -> Option<T>) -> Option<T> {
        let mut jobs = self.lock();
        while !jobs.is_closed {
            let taken = take(&mut jobs);
            if taken.is_some() {
                return taken;
            }
            jobs = self.changed.wait(jobs).unwrap_or_else(PoisonError::into_inner);
        }
        None
    }

    /// Waits for the next job to render; `None` once the queue is closed.
    pub(super) fn next(&self) -> Option<Job> {
        self.wait_for(|jobs| self.take(jobs))
    }

    /// Waits for the next job to render, but no longer than `timeout`.
    pub(super) fn next_within(&self, timeout: Duration) -> Option<Job> {
        let mut jobs = self.lock();
        if let Some(job) = self.take(&mut jobs) {
            return Some(job);
        }
        if jobs.is_closed || timeout.is_zero() {
            return None;
        }
        let waited = self.changed.wait_timeout(jobs, timeout);
        self.take(&mut waited.unwrap_or_else(PoisonError::into_inner).0)
    }

    /// Passes a rendering on to the encoder, or answers the job with the error.
    pub(super) fn finish_rendering(&self, job: Job, result: Result<RenderedPicture, RenderError>) {
        match result {
            Err(error) => self.finish(job, Err(error)),
            Ok(rendered) => {
                let mut jobs = self.lock();
                // A closed queue has no encoder.
                if !jobs.is_closed {
                    jobs.rendered.push((job, rendered));
                }
                drop(jobs);
                self.changed.notify_all();
            }
        }
    }

    /// Waits for the next rendering to encode; `None` once the queue is closed.
    pub(super) fn next_rendered(&self) -> Option<(Job, RenderedPicture)> {
        self.wait_for(|jobs| (!jobs.rendered.is_empty()).then(|| jobs.rendered.remove(0)))
    }

    /// Answers an active job.
    pub(super) fn finish(&self, job: Job, result: Result<EncodedPicture, RenderError>) {
        job.reply(result);
        self.lock().active -= 1;
        self.changed.notify_all();
    }

    /// True once [`close`](Self::close) was called.
    pub(super) fn is_closed(&self) -> bool {
        self.lock().is_closed
    }

    /// Refuses further requests and answers all waiting ones.
    pub(super) fn close(&self) {
        let (waiting, rendered) = {
            let mut jobs = self.lock();
            jobs.is_closed = true;
            (std::mem::take(&mut jobs.waiting), std::mem::take(&mut jobs.rendered))
        };
        for job in waiting.into_iter().chain(rendered.into_iter().map(|(job, _)| job)) {
            job.reply(Err(RenderError::Closed));
        }
        self.changed.notify_all();
    }
}

/// Closes the queue when dropped, even if its thread panics.
pub(super) struct CloseOnDrop<'a>(pub(super) &'a RenderQueue);

impl Drop for CloseOnDrop<'_> {
    fn drop(&mut self) {
        if thread::panicking() {
            tracing::error!(
                "a thread of the page failed, so the page shows no more pictures; this is a bug"
            );
        }
        self.0.close();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::picture_kind::PictureKind;

    fn picture_request(page: &str, number: usize) -> PictureRequest {
        PictureRequest::of_view(page, PictureKind::Render, (8, 8), number)
    }

    fn wait_until(queue: &RenderQueue, is_reached: impl Fn(&Jobs) -> bool) {
        while !is_reached(&queue.lock()) {
            thread::yield_now();
        }
    }

    #[test]
    fn a_full_queue_refuses_requests() {
        let queue = RenderQueue::new(Some(1), 1);
        assert!(queue.next_within(Duration::ZERO).is_none());
        thread::scope(|scope| {
            let first = scope.spawn(|| queue.submit(picture_request("a", 0)));
            wait_until(&queue, |jobs| !jobs.waiting.is_empty());
            assert_eq!(queue.submit(picture_request("b", 0)).unwrap_err(), RenderError::QueueFull);
            // A newer request of the waiting pane replaces the older one.
            let second = scope.spawn(|| queue.submit(picture_request("a", 1)));
            assert_eq!(first.join().unwrap().unwrap_err(), RenderError::Superseded);
            let job = queue.next_within(Duration::ZERO).unwrap();
            queue.finish_rendering(job, Err(RenderError::Failed("fake".into())));
            assert_eq!(second.join().unwrap().unwrap_err(), RenderError::Failed("fake".into()));
            assert!(!queue.is_closed());
            queue.close();
            assert!(queue.is_closed() && queue.next_within(Duration::from_secs(60)).is_none());
        });
    }

    #[test]
    fn active_jobs_are_limited_until_their_pictures_are_encoded() {
        let queue = RenderQueue::new(None, 1);
        let picture = EncodedPicture { jpeg: vec![3], ..EncodedPicture::default() };
        thread::scope(|scope| {
            let replies = ["a", "b"].map(|page| {
                let queue = &queue;
                scope.spawn(move || {
                    queue.submit(picture_request(page, 0)).map(|picture| picture.jpeg)
                })
            });
            wait_until(&queue, |jobs| jobs.waiting.len() >= 2);
            let job = queue.next_within(Duration::ZERO).unwrap();
            assert!(queue.next_within(Duration::ZERO).is_none(), "two active jobs");
            let (first, second) = match (&*job.request.pane.0, replies) {
                ("a", [first, second]) | (_, [second, first]) => (first, second),
            };
            queue.finish_rendering(job, Ok(RenderedPicture::default()));
            // Rendered but not encoded still counts as active.
            assert!(queue.next_within(Duration::ZERO).is_none());
            let (job, _) = queue.next_rendered().unwrap();
            queue.finish(job, Ok(picture));
            assert_eq!(first.join().unwrap().unwrap(), [3]);
            let job = queue.next().unwrap();
            queue.finish_rendering(job, Err(RenderError::Failed("fake".into())));
            assert!(second.join().unwrap().is_err());
            // Closing also answers jobs that are rendered but not encoded.
            let last = scope.spawn(|| queue.submit(picture_request("c", 0)).unwrap_err());
            let job = queue.next().expect("a failed job is no longer active");
            queue.finish_rendering(job, Ok(RenderedPicture::default()));
            queue.close();
            assert_eq!(last.join().unwrap(), RenderError::Closed);
            assert!(queue.next_rendered().is_none());
        });
    }

    #[test]
    fn only_the_newest_request_of_a_pane_is_kept_and_none_starves() {
        let queue = RenderQueue::new(None, 1);
        let failed = || RenderError::Failed("fake".into());
        let waiting = |count: usize| wait_until(&queue, |jobs| jobs.waiting.len() >= count);
        let newest_is = |number: usize| {
            let newest = picture_request("a", number);
            wait_until(&queue, |jobs| jobs.waiting[0].request == newest);
        };
        thread::scope(|scope| {
            let submit = |page, number| {
                scope.spawn({
                    let queue = &queue;
                    move || queue.submit(picture_request(page, number))
                })
            };
            let first = submit("a", 0);
            waiting(1);
            let other = submit("b", 9);
            waiting(2);
            let second = submit("a", 1);
            newest_is(1);
            let third = submit("a", 2);
            newest_is(2);
            assert_eq!(first.join().unwrap().unwrap_err(), RenderError::Superseded);
            assert_eq!(second.join().unwrap().unwrap_err(), RenderError::Superseded);
            for (expected, replies) in
                [(picture_request("a", 2), third), (picture_request("b", 9), other)]
            {
                let job = queue.next().unwrap();
                assert_eq!(job.request, expected);
                queue.finish_rendering(job, Err(failed()));
                assert_eq!(replies.join().unwrap().unwrap_err(), failed());
            }
            let left = submit("c", 0);
            waiting(1);
            drop(CloseOnDrop(&queue));
            assert_eq!(left.join().unwrap().unwrap_err(), RenderError::Closed);
        });
        assert!(queue.next().is_none());
        assert_eq!(queue.submit(picture_request("a", 0)).unwrap_err(), RenderError::Closed);
    }
}
