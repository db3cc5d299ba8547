//! The memory of this process, and the system's limits on it. A run measures it only through the [`ProcessMemory`] that
//! its caller provides.

use std::fs::read_to_string;
use std::path::Path;

use densify_core::memory::{parse_status, peak_resident, resident, status_line};

/// Address space that the allocator maps in addition to requests `[bytes]`.
const ALLOCATOR_SLACK: u64 = 16 << 20;
/// Address space per thread: a stack, and a heap of its own (glibc) `[bytes]`.
const ADDRESSES_PER_THREAD: u64 = (2 + 64) << 20;

/// Measures the memory of the process. Each function returns `None` if the system does not report the value.
#[derive(Debug, Clone, Copy)]
pub struct ProcessMemory {
    /// Resident memory now `[bytes]`.
    pub resident: fn() -> Option<u64>,
    /// Peak resident memory so far `[bytes]`.
    pub peak: fn() -> Option<u64>,
    /// The tightest limit on the memory of a process with this many busy threads.
    pub grant: fn(usize) -> Option<MemoryLimit>,
}

impl ProcessMemory {
    /// Reports what the operating system reports (on Linux).
    pub const SYSTEM: Self = Self { resident, peak: peak_resident, grant };
    /// Reports nothing, so that no run is refused for lack of memory.
    pub const UNKNOWN: Self = Self { resident: || None, peak: || None, grant: |_| None };
}

/// Memory left to the process, and the limit that determines it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MemoryLimit {
    /// Memory that the process can still obtain `[bytes]`.
    pub left: u64,
    /// Name of the limit, for messages.
    pub name: &'static str,
}

/// The tightest memory limit that the system sets (on Linux). Runs that need more are refused before they start,
/// because a failed allocation would abort the process without a message.
pub fn grant(threads: usize) -> Option<MemoryLimit> {
    let grants = [
        address_space(threads)
            .map(|left| MemoryLimit { left, name: "the limit of its address space (ulimit -v)" }),
        control_group()
            .map(|left| MemoryLimit { left, name: "the memory limit of its control group" }),
        available()
            .map(|left| MemoryLimit { left, name: "the memory that the system has available" }),
    ];
    grants.into_iter().flatten().min_by_key(|grant| grant.left)
}

fn address_space(threads: usize) -> Option<u64> {
    let limit = parse_limit(&read_to_string("/proc/self/limits").ok()?)?;
    let reserved =
        ADDRESSES_PER_THREAD.saturating_mul(threads as u64).saturating_add(ALLOCATOR_SLACK);
    Some(limit.saturating_sub(status_line("VmSize:")?).saturating_sub(reserved))
}

/// The soft limit in `/proc/self/limits`, "Max address space   SOFT   HARD   bytes"; `None` for
/// "unlimited".
fn parse_limit(limits: &str) -> Option<u64> {
    let line = limits.lines().find_map(|line| line.strip_prefix("Max address space"))?;
    line.split_whitespace().next()?.parse().ok()
}

/// Memory left to the control group (version 2). In a container, the container's group is the visible root.
fn control_group() -> Option<u64> {
    let groups = read_to_string("/proc/self/cgroup").ok()?;
    let group = groups.lines().find_map(|line| line.strip_prefix("0::/"))?;
    let folder = Path::new("/sys/fs/cgroup").join(group);
    let read = |name: &str| read_to_string(folder.join(name)).ok();
    group_left(&read("memory.max")?, &read("memory.current")?, &read("memory.stat")?)
}

/// Memory left to a control group. Cached files are part of its current use, but are evicted first.
fn group_left(max: &str, current: &str, stat: &str) -> Option<u64> {
    // "max": no limit.
    let max: u64 = max.trim().parse().ok()?;
    let current: u64 = current.trim().parse().ok()?;
    let cached = stat.lines().find_map(|line| line.strip_prefix("inactive_file "));
    let cached = cached.and_then(|bytes| bytes.trim().parse().ok()).unwrap_or(0);
    Some(max.saturating_sub(current.saturating_sub(cached)))
}

/// Memory that the system has available, swap included. `/proc/meminfo` has the format of `/proc/self/status`.
fn available() -> Option<u64> {
    let memory = read_to_string("/proc/meminfo").ok()?;
    let free = parse_status(&memory, "MemAvailable:")?;
    Some(free + parse_status(&memory, "SwapFree:").unwrap_or(0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_soft_limit_of_the_address_space_is_read() {
        let limits = |soft: &str| {
            format!(
                "Limit                     Soft Limit           Hard Limit           Units     \n\
                 Max cpu time              unlimited            unlimited            seconds   \n\
                 Max address space         {soft:<20} unlimited            bytes     \n"
            )
        };
        assert_eq!(parse_limit(&limits("409600000")), Some(409_600_000));
        assert_eq!(parse_limit(&limits("unlimited")), None);
        assert_eq!(parse_limit(""), None);
    }

    #[test]
    fn cached_files_do_not_count_as_used() {
        let stat = "anon 100\nfile 500\ninactive_file 300\nactive_file 200\n";
        assert_eq!(group_left("1000\n", "900\n", stat), Some(400));
        assert_eq!(group_left("1000\n", "1300\n", stat), Some(0));
        assert_eq!(group_left("1000\n", "900\n", ""), Some(100));
        assert_eq!(group_left("max\n", "900\n", stat), None);
    }
}
