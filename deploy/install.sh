#!/bin/sh
# Installs dart-flight on Raspberry Pi OS 64-bit (bookworm or trixie) or another Debian, from a checkout:
#
#     sudo deploy/install.sh
#
# Program: /opt/dart-flight/venv. Configuration, missions, logs: /srv/dart-flight, kept when it exists.
# Run it again after `git pull` to update. Needs the network for Debian's and Python's packages.
set -eu

here=$(cd "$(dirname "$0")/.." && pwd)
venv=/opt/dart-flight/venv
lab=/srv/dart-flight

[ "$(id -u)" = 0 ] || { echo "run it with sudo" >&2; exit 2; }
case $(dpkg --print-architecture 2>/dev/null) in
    arm64 | amd64) ;;
    *) echo "needs a 64-bit Debian or Raspberry Pi OS: mavsdk has no wheel for another" >&2; exit 2 ;;
esac

apt-get update  # a fresh root has no package lists, an old one names versions that are gone
apt-get install --yes --no-install-recommends python3 python3-venv adduser
python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
    { echo "needs Python 3.11 or newer, here is $(python3 --version)" >&2; exit 2; }

python3 -m venv "$venv"
"$venv/bin/python" -m pip install --disable-pip-version-check -c "$here/constraints.txt" "$here[sim,identify,report,live,mocap]"
ln -sf "$venv/bin/dart-flight" /usr/local/bin/dart-flight

# The account that flies: serial ports and GPIO, nothing else. Its group may edit missions.
id dart >/dev/null 2>&1 || adduser --system --group --home "$lab" --no-create-home dart
for group in dialout gpio; do
    getent group "$group" >/dev/null || addgroup --system "$group"
    adduser dart "$group"
done
[ -z "${SUDO_USER:-}" ] || [ "$SUDO_USER" = root ] || { adduser "$SUDO_USER" dart; adduser "$SUDO_USER" dialout; }

[ -e "$lab/configs/dart.yaml" ] || "$venv/bin/dart-flight" init "$lab"
chown -R dart:dart "$lab"
chmod -R g+w "$lab"
find "$lab" -type d -exec chmod g+s {} +

install -D -m 644 "$here/deploy/systemd/dart-flight@.service" /etc/systemd/system/dart-flight@.service
install -D -m 644 "$here/deploy/systemd/dart-flight-standby.service" /etc/systemd/system/dart-flight-standby.service
install -D -m 644 "$here/deploy/udev/99-dart-flight.rules" /etc/udev/rules.d/99-dart-flight.rules
install -d /usr/share/bash-completion/completions
"$venv/bin/dart-flight" completion bash >/usr/share/bash-completion/completions/dart-flight
if [ -d /run/systemd/system ]; then
    systemctl daemon-reload
    udevadm control --reload
    udevadm trigger
fi
"$venv/bin/dart-flight" --version
echo "installed; log out and in again, then: cd $lab && dart-flight check missions/single_wall.yaml"
