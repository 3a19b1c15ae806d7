#!/bin/bash
# The first process of User-mode Linux: a server of NFS, and two clients in network namespaces of their own, on one kernel.
# $SCRATCH/work is run then, with mounts of one export at /mnt/a and /mnt/b.
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t tmpfs tmp /run
mount -t tmpfs tmp /mnt
mkdir -p /mnt/served /mnt/a /mnt/b
modules=$(echo /usr/lib/uml/modules/*/kernel)
for name in net/sunrpc/sunrpc fs/nfs_common/grace fs/lockd/lockd fs/nfs_common/nfs_acl lib/oid_registry \
    net/sunrpc/auth_gss/auth_rpcgss fs/nfsd/nfsd fs/netfs/netfs fs/fscache/fscache fs/nfs/nfs net/dns_resolver/dns_resolver fs/nfs/nfsv4 drivers/net/veth; do
    [ -e "$modules/$name.ko" ] && insmod "$modules/$name.ko"
done
ip link set lo up
mount -t ext4 /dev/ubda /mnt/served
mount -t tmpfs tmp /var/lib
mkdir -p /var/lib/nfs/v4recovery /var/lib/nfs/rpc_pipefs /run/netns
touch /var/lib/nfs/etab /var/lib/nfs/rmtab
mount -t nfsd nfsd /proc/fs/nfsd
mount -t rpc_pipefs rpc /var/lib/nfs/rpc_pipefs
exportfs -o rw,no_root_squash,fsid=0,insecure,no_subtree_check '*:/mnt/served' 2>/dev/null
rpc.mountd -N 3 -F 2>/dev/null &
sleep 1
echo 10 >/proc/fs/nfsd/nfsv4leasetime
echo 10 >/proc/fs/nfsd/nfsv4gracetime # else the first write waits for 90 s
rpc.nfsd -N 3 4
number=1
for client in a b; do
    net=10.0.$number
    ip netns add $client
    ip link add v$client type veth peer name e$client
    ip link set e$client netns $client
    ip addr add $net.1/24 dev v$client
    ip link set v$client up
    ip netns exec $client ip addr add $net.2/24 dev e$client
    ip netns exec $client ip link set e$client up
    nsenter --net=/run/netns/$client unshare --uts sh -c "hostname client-$client; mount -i -t nfs4 \
        -o vers=4.2,addr=$net.1,clientaddr=$net.2,nosharecache $net.1:/ /mnt/$client"
    number=$((number + 1))
done
echo "CLIENTS $(ls /proc/fs/nfsd/clients | wc -w)"
bash "$SCRATCH/work"
sync
echo o >/proc/sysrq-trigger
sleep 60
