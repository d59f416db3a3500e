# Sourced by tests/qemu/run and tests/qemu/display: QEMU and busybox out of Debian's packages, a guest's file system, a boot.
#
# No build machine has the devices that are tested, so QEMU emulates a machine (TCG: no KVM is needed) in which a kernel
# makes them. Everything is downloaded with apt-get and unpacked under the target folder; nothing is installed. Root, or
# sudo, is needed only where apt has no package lists yet.

target="$(realpath -m "${CARGO_TARGET_DIR:-target}")"
parts="$target/qemu"
system="$parts/system"
began=$SECONDS

say() { printf '%s\n' "$*"; }

# apt's own lists, where there are none yet.
need_lists() {
    local as_root=()
    apt-cache show linux-image-amd64 qemu-system-x86 >/dev/null 2>&1 && return
    ((EUID == 0)) || as_root=(sudo)
    "${as_root[@]}" apt-get update -q
}

# QEMU and busybox, once.
fetch_machine() {
    [[ -f $system/complete ]] && return
    local debs="$parts/debs" deb
    rm -rf "$system"
    mkdir -p "$debs/partial" "$system"
    need_lists
    say "downloading busybox-static and QEMU with its libraries"
    (cd "$debs" && apt-get download -qq -o APT::Sandbox::User=root busybox-static)
    # Everything that is not installed; what is installed is on the library path anyway. Nothing is put on the machine.
    command -v qemu-system-x86_64 >/dev/null ||
        apt-get install -qqy --download-only --no-install-recommends -o Debug::NoLocking=1 \
            -o APT::Sandbox::User=root -o Dir::Cache::archives="$debs" qemu-system-x86 >/dev/null
    for deb in "$debs"/*.deb; do
        dpkg-deb -x "$deb" "$system"
    done
    rm -rf "$debs"
    touch "$system/complete"
}

# The kernel out of its own decompressor, which an emulated machine is slow at; as it is where it is packed otherwise.
unpack_kernel() {
    python3 - "$1" "$2" <<'PYTHON'
import lzma, pathlib, sys
packed = pathlib.Path(sys.argv[1]).read_bytes()
try:
    kernel = lzma.LZMADecompressor().decompress(packed[packed.index(b"\xfd7zXZ\0"):])
except (ValueError, lzma.LZMAError):
    kernel = packed
pathlib.Path(sys.argv[2]).write_bytes(kernel)
PYTHON
}

qemu() {
    if command -v qemu-system-x86_64 >/dev/null; then
        qemu-system-x86_64 "$@"
    else
        LD_LIBRARY_PATH="$system/usr/lib/x86_64-linux-gnu:$system/lib/x86_64-linux-gnu" \
            "$system/usr/bin/qemu-system-x86_64" -L "$system/usr/share/qemu" -L "$system/usr/share/seabios" "$@"
    fi
}

# new_guest FOLDER: an empty file system with busybox and two users.
new_guest() {
    rm -rf "$1"
    mkdir -p "$1"/{bin,dev,etc,modules,proc,sys,tmp}
    cp "$system/bin/busybox" "$1/bin/"
    printf 'root:x:0:0::/:/bin/sh\nviewer:x:1000:1000::/:/bin/sh\n' >"$1/etc/passwd"
}

# add_programs FOLDER PROGRAM...: programs with their libraries.
add_programs() {
    local guest="$1" program library
    for program in "${@:2}"; do
        strip -o "$guest/bin/${program##*/}" "$program"
        for library in $(ldd "$program" | grep -o '/[^ ]*'); do
            mkdir -p "$guest${library%/*}"
            cp -L "$library" "$guest$library"
        done
    done
}

# pack_guest FOLDER FILE
pack_guest() {
    (cd "$1" && find . | "$system/bin/busybox" cpio -o -H newc 2>/dev/null) >"$2"
}

# boot KERNEL GUEST_FILE LOGS LIMIT_S OPTION...: runs the guest; what it says goes to LOGS.console and LOGS.result.
#
# The guest's clock counts its instructions (icount): a busy host makes the test slower, and the guest late only now
# and then.
boot() {
    local kernel="$1" guest="$2" logs="$3" limit_s="$4"
    rm -f "$logs.console" "$logs.result"
    timeout --kill-after=5 "$limit_s" bash -c "$(declare -f qemu); system='$system'; qemu \"\$@\"" -- \
        -machine pc -accel tcg -cpu max -nodefaults -display none -no-reboot "${@:5}" \
        -kernel "$kernel" -initrd "$guest" \
        -append "console=ttyS0 panic=-1 nokaslr mitigations=off quiet" \
        -serial "file:$logs.console" -serial "file:$logs.result" </dev/null
}

# judged STATUS LOGS LIMIT_S JUDGE...: whether a boot went well and its judge agrees; else all that the guest said.
judged() {
    local status="$1" logs="$2" limit_s="$3"
    if ((status != 0)) || ! python3 "${@:4}" "$logs.result"; then
        printf '\nthe guest (QEMU exit code %d, 124 is the limit of %d s) said:\n' "$status" "$limit_s"
        cat "$logs.console" "$logs.result" || true
        return 1
    fi
}
