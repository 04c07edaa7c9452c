"""Real parts of a cluster as processes on this machine: a Dask scheduler, its workers, and an S3 server."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

BUCKET = "lab"
KEYS = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_REGION": "us-east-1"}
UP_S = 60
"""How long a process may take to begin, on a machine that is busy."""


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


@contextmanager
def running(*command, env=None, log=subprocess.DEVNULL):
    """A process, killed at the end if it is not gone."""
    whole = {**os.environ, **(env or {}), "OPENBLAS_NUM_THREADS": "1"}
    process = subprocess.Popen(list(map(str, command)), env=whole, stdout=log, stderr=log, start_new_session=True)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGCONT)
            process.kill()
        process.wait()


def wait_for(look, what):
    until = time.monotonic() + UP_S
    while time.monotonic() < until:
        try:
            if look():
                return
        except OSError:
            pass
        time.sleep(0.05)
    raise AssertionError(f"{what} did not come up in {UP_S} s")


def answers(port):
    with socket.create_connection(("127.0.0.1", port), timeout=1):
        return True


@dataclass
class S3:
    """An S3 server, the variables by which it is found, and the URL of an empty store there."""

    process: subprocess.Popen
    port: int
    env: dict = field(init=False)

    def __post_init__(self):
        place = {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{self.port}", "AWS_ALLOW_HTTP": "true"}
        self.env = KEYS | place

    def url(self, name):
        return f"s3://{BUCKET}/{name}"


@contextmanager
def moto():
    """Moto's S3 server with an empty bucket; what is stored is in its memory."""
    port = free_port()
    code = f"from moto.server import main; main(['-H', '127.0.0.1', '-p', '{port}'])"
    with running(sys.executable, "-c", code) as process:
        wait_for(lambda: answers(port), "moto")
        make = urllib.request.Request(f"http://127.0.0.1:{port}/{BUCKET}", method="PUT")
        with urllib.request.urlopen(make, timeout=60) as answer:
            assert answer.status == 200
        yield S3(process, port)


@dataclass
class Cluster:
    """A scheduler and its workers."""

    scheduler: subprocess.Popen
    workers: list
    address: str


@contextmanager
def scheduler(folder, port):
    with open(folder / "scheduler.log", "ab") as log:
        quiet = ["--no-dashboard", "--no-jupyter", "--host", "127.0.0.1", "--port", port]
        with running(sys.executable, "-m", "dask", "scheduler", *quiet, log=log) as process:
            wait_for(lambda: answers(port), "scheduler")
            yield process


@contextmanager
def worker(folder, port, number, env=None):
    """A worker without a nanny, which would begin another one when it is killed."""
    with open(folder / f"worker-{number}.log", "ab") as log:
        place = ["--local-directory", folder, "--name", f"w{number}"]
        quiet = ["--no-dashboard", "--no-nanny", "--nthreads", 1, *place]
        with running(
            sys.executable, "-m", "dask", "worker", f"tcp://127.0.0.1:{port}", *quiet, log=log, env=env
        ) as one:
            yield one


@contextmanager
def dask(folder: Path, workers=2, env=None):
    """A scheduler with workers, which have all come up."""
    from distributed import Client

    port = free_port()
    with ExitStack() as stack:
        leader = stack.enter_context(scheduler(folder, port))
        hands = [stack.enter_context(worker(folder, port, number, env)) for number in range(workers)]
        with Client(f"tcp://127.0.0.1:{port}", timeout=UP_S, set_as_default=False) as client:
            client.wait_for_workers(workers, timeout=UP_S)
        yield Cluster(leader, hands, f"dask://127.0.0.1:{port}")


class Seaweed:
    """A SeaweedFS server (one process) whose files outlive it: it can be killed and started again."""

    def __init__(self, folder):
        self.folder = folder
        names = ("s3", "master", "volume", "filer")
        self.ports = {f"-{name}.port{kind}": free_port() for name in names for kind in ("", ".grpc")}
        allowed = ["Admin", "Read", "Write", "List"]
        keys = {"accessKey": KEYS["AWS_ACCESS_KEY_ID"], "secretKey": KEYS["AWS_SECRET_ACCESS_KEY"]}
        users = {"identities": [{"name": "lab", "credentials": [keys], "actions": allowed}]}
        (folder / "s3.json").write_text(json.dumps(users))
        (folder / "data").mkdir()

    @contextmanager
    def running(self):
        place = [f"-dir={self.folder / 'data'}", f"-s3.config={self.folder / 's3.json'}", "-volume.max=20"]
        sockets = [f"-{name}.localSocket={self.folder / name}.sock" for name in ("s3", "filer")]
        ports = [f"{name}={port}" for name, port in self.ports.items()]
        weed = Path(sys.executable).with_name("weed")
        with open(self.folder / "weed.log", "ab") as log:
            command = [weed, "-logtostderr=true", "server", "-ip=127.0.0.1", "-s3", *place, *sockets, *ports]
            with running(*command, "-master.volumeSizeLimitMB=64", log=log) as process:
                port = self.ports["-s3.port"]
                wait_for(lambda: answers(port), "SeaweedFS")
                one = S3(process, port)
                wait_for(lambda: make_bucket(one), "its bucket")
                yield one


def make_bucket(s3):
    """Make the bucket, if it is not there, with a signed request."""
    import boto3
    from botocore.exceptions import BotoCoreError, ClientError

    names = dict(zip(("aws_access_key_id", "aws_secret_access_key", "region_name"), KEYS.values(), strict=True))
    client = boto3.client("s3", endpoint_url=s3.env["AWS_ENDPOINT_URL"], **names)
    try:
        client.create_bucket(Bucket=BUCKET)
    except ClientError as error:
        return error.response["Error"]["Code"].startswith("BucketAlready")
    except BotoCoreError:
        return False
    return True
