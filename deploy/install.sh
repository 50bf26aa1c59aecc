#!/bin/sh
# Installs dart-flight from a checkout on 64-bit Raspberry Pi OS (bookworm or trixie) or another Debian:
#
#     sudo deploy/install.sh
#
# The program goes to /opt/dart-flight/venv. Configuration, missions and logs are in /srv/dart-flight. Existing
# files there are kept. To update, run this script again after `git pull`. The script needs the network.
set -eu

here=$(cd "$(dirname "$0")/.." && pwd)
venv=/opt/dart-flight/venv
lab=/srv/dart-flight

[ "$(id -u)" = 0 ] || { echo "run this script with sudo" >&2; exit 2; }
case $(dpkg --print-architecture 2>/dev/null) in
    arm64 | amd64) ;;
    *) echo "install a 64-bit Debian or Raspberry Pi OS: mavsdk has no wheels for other systems" >&2; exit 2 ;;
esac

apt-get update  # a new system has no package lists, and old lists name versions that no longer exist
apt-get install --yes --no-install-recommends python3 python3-venv adduser
python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
    { echo "install Python 3.11 or newer; this system has $(python3 --version)" >&2; exit 2; }

python3 -m venv "$venv"
"$venv/bin/python" -m pip install --disable-pip-version-check -c "$here/constraints.txt" "$here[sim,identify,report,live,mocap]"
ln -sf "$venv/bin/dart-flight" /usr/local/bin/dart-flight

# The account that flies may use only serial ports and GPIO. Members of its group may edit missions.
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
