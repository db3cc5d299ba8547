#!/usr/bin/env bash
# Starts a Slurm cluster of two nodes on this machine, runs a command with it, and stops it.
#
#   tests/engines/slurm.sh COMMAND ARGUMENT...
#
# Needs root, and Debian's slurmctld, slurmd, slurm-client and munge. All files are in a temporary folder; an installed
# Slurm is not affected.
set -euo pipefail

folder="$(mktemp -d)"
chmod 755 "$folder"
stop() {
    set +e
    for file in "$folder"/*.pid; do
        [ -e "$file" ] && kill "$(cat "$file")" 2>/dev/null
    done
    sleep 1
    rm -rf "$folder"
}
trap stop EXIT

# A fresh munge key that only root can read, so that only root can submit jobs.
dd if=/dev/urandom of="$folder/key" bs=1024 count=1 status=none
chmod 400 "$folder/key"
munged --force --key-file="$folder/key" --socket="$folder/munge" --pid-file="$folder/munge.pid" \
    --log-file="$folder/munge.log" --seed-file="$folder/seed" 2>"$folder/munge.err"

cat >"$folder/slurm.conf" <<EOF
ClusterName=loopback
SlurmctldHost=localhost(127.0.0.1)
SlurmctldPort=17000
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket=$folder/munge
CredType=cred/munge
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool-%n
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd-%n.pid
SlurmctldLogFile=$folder/slurmctld.log
SlurmdLogFile=$folder/slurmd-%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
MpiDefault=none
ReturnToService=2
KillWait=5
NodeName=node1 NodeHostname=localhost NodeAddr=127.0.0.1 Port=17001 CPUs=1 RealMemory=1000
NodeName=node2 NodeHostname=localhost NodeAddr=127.0.0.1 Port=17002 CPUs=1 RealMemory=1000
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
EOF
export SLURM_CONF="$folder/slurm.conf"
mkdir "$folder/state"
slurmctld -c
for node in node1 node2; do
    mkdir "$folder/spool-$node"
    slurmd -N "$node"
done
for _ in $(seq 60); do
    [ "$(sinfo --noheader --format=%T --Node 2>/dev/null | grep -c idle)" = 2 ] && break
    sleep 1
done
sinfo --Node || { cat "$folder"/*.log >&2; exit 1; }
"$@"
