//! Memory that the allocator keeps.

/// Hands what has been freed back to the operating system. glibc's allocator keeps the holes in its heaps, which after
/// some changes of engine are several times of what is in use. Its heaps are locked meanwhile.
pub(crate) fn give_back() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: it takes a number, touches nothing but free memory, and may be called from any thread at any time.
    unsafe {
        libc::malloc_trim(0);
    }
}
