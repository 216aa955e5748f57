#!/bin/sh
# Installs the system packages that some tests use, where this is allowed (root with apt).
# Elsewhere nothing happens here: those tests skip themselves and say which program they miss.
set -eu
wanted=""
need() { command -v "$1" >/dev/null 2>&1 || wanted="$wanted $2"; }
need storescu dcmtk
need Orthanc orthanc
need chromium chromium
need nginx nginx-light
need caddy caddy
need docker-compose docker-compose
need dciodvfy dicom3tools
[ -n "$wanted" ] || exit 0
if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null 2>&1; then
    echo "not installed (needs root and apt):$wanted; the tests that use them will be skipped" >&2
    exit 0
fi
export DEBIAN_FRONTEND=noninteractive
if apt-get update -qq >/dev/null && apt-get install -y -qq --no-install-recommends $wanted >/dev/null 2>&1; then
    exit 0
fi
echo "could not install:$wanted; the tests that use them will be skipped" >&2
