#!/bin/sh
# Install the system packages named, where root or passwordless sudo allows; else say what to type.
#   tools/system-packages.sh [OPTION OF APT-GET] PACKAGE...
# Fails when a package stays missing and CI is true; elsewhere what needs it will say so.
set -eu

missing=
options=
for package in "$@"; do
    case $package in -*) options="$options $package"; continue ;; esac
    if ! dpkg-query -W -f '${db:Status-Abbrev}' "$package" 2>/dev/null | grep -q '^ii'; then
        missing="$missing $package"
    fi
done
[ -n "$missing" ] || exit 0

give_up() {
    echo "$1" >&2
    [ "${CI:-}" != true ] || exit 1
    exit 0
}

command -v apt-get >/dev/null 2>&1 ||
    give_up "these packages are needed, by the names they have on Debian; install them with your system's tools:$missing"
if [ "$(id -u)" = 0 ]; then
    as_root=env
elif command -v sudo >/dev/null 2>&1 && sudo -n true 2>/dev/null; then
    as_root="sudo -n env"
else
    give_up "packages are missing; type: sudo apt-get install$missing"
fi

echo "installing system packages:$missing" >&2
install() {
    # Unquoted on purpose: several words each.
    $as_root DEBIAN_FRONTEND=noninteractive apt-get install -y -qq $options $missing >/dev/null
}
install 2>/dev/null || { $as_root apt-get update -qq >/dev/null && install; } ||
    give_up "apt-get could not install them; type: sudo apt-get update && sudo apt-get install$missing"
