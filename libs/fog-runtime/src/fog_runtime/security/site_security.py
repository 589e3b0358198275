"""The security of a site in one folder: an authority, a certificate and lists for each server, credentials of users.

    locks.json                                    for which site and hosts they were made
    authority.pem                                 stays on the fog node, and is read by nothing that runs
    mosquitto/  server.pem server.key passwords access
    redis/      server.pem server.key users
    zenoh/      server.pem server.key users access.json5
    http/       server.pem server.key             of the REST APIs and the gateway
    credentials/NAME.toml                         one file for each user (`fog_runtime.credentials`)
    credentials/SITE/NAME.toml                    the same for further sites of the same servers, its floors

Each server reads its own folder, each service its own credentials, so that none has another's secrets. Whoever adds a
user hands out its file; here it may be removed then.
"""

from __future__ import annotations

import datetime as dt
import stat
from typing import TYPE_CHECKING, Final, Self

import msgspec

from fog_contracts.channels import BROKER_NAME
from fog_contracts.generate.acl import mqtt_acl, zenoh_acl
from fog_runtime.credentials import SERVERS, Credentials, Server, to_toml
from fog_runtime.files import PRIVATE, atomic_write
from fog_runtime.security import users
from fog_runtime.security.authority import SERVER_DAYS, Authority, expiry
from fog_runtime.security.users import ANYBODY, Members, SecurityError, ServerFiles, require_own_topics, user_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

_PLAN: Final = "locks.json"
AUTHORITY: Final = "authority.pem"
CREDENTIALS: Final = "credentials"
PROGRAMS: Final = ("mosquitto", "redis", "zenoh", "http")
"""The folders of what has a certificate."""
CERTIFICATE, KEY, ACCESS = "server.pem", "server.key", "access"
_RENEW_BEFORE: Final = dt.timedelta(days=SERVER_DAYS // 3)
_DAY: Final = dt.timedelta(days=1)
_PROGRAM_OF: Final[Mapping[Server, str]] = {"mqtt": "mosquitto", "zenoh": "zenoh", "redis": "redis"}


class _Plan(msgspec.Struct, frozen=True):
    site: str
    hosts: list[str] = []
    unrestricted: list[str] = []
    mode: int = PRIVATE
    floors: list[str] = []
    devices: dict[str, list[str]] = {}
    copies: bool = False


class SiteSecurity:
    """The credentials in a folder. Its methods may be repeated: what is there already stays."""

    def __init__(self, folder: Path, site: str, *, unrestricted: Sequence[str] = (), mode: int = PRIVATE) -> None:
        """Take a folder, which `make` fills; `mode` are the permissions of what the servers read.

        The users named in `unrestricted` may do everything on broker and router (replaying, tests).
        """
        self._folder = folder
        self._plan = _Plan(site=site, unrestricted=list(unrestricted), mode=mode)

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Open the credentials that `make` has made in a folder; raises `SecurityError`."""
        try:
            opened = cls(folder, "")
            opened._plan = _read_plan(folder)
        except OSError as error:
            raise SecurityError(
                f"{folder} has no certificates and users of a site ({error.strerror}). Create them "
                f"(fognav ca create --credentials {folder})"
            ) from error
        except msgspec.DecodeError as error:
            raise SecurityError(f"{folder / _PLAN}: {error}. Restore it from a backup") from error
        return opened

    def make(
        self, hosts: Sequence[str], *, robots: Sequence[str] = (), nodes: Sequence[str] = (), copies: bool = False
    ) -> None:
        """Create what is missing: the authority, servers' certificates, the services' and tools' users, these robots'.

        `hosts` are the names and addresses by which clients reach the servers, besides those of before. Certificates
        that expire soon, or lack one of them, are renewed. With `copies` each server has others, which get what it
        has. Raises `SecurityError` or `AuthorityError`.
        """
        before = _read_plan(self._folder) if (self._folder / _PLAN).exists() else self._plan
        if before.site != self._plan.site:
            raise SecurityError(
                f"{self._folder} has the credentials of site {before.site}, not of {self._plan.site}: name a folder "
                "(or volume) of its own for each site"
            )
        known_hosts = before.hosts
        self._plan = msgspec.structs.replace(
            self._plan, floors=before.floors, devices=before.devices, copies=copies or before.copies
        )
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not (self._folder / AUTHORITY).exists():
            Authority.create(self._folder / AUTHORITY, f"Fognav {self._plan.site}", now=_now())
        wanted = [*known_hosts, *(host for host in (*hosts, BROKER_NAME) if host not in known_hosts)]
        self.renew(wanted, only_due=wanted == known_hosts)
        own: dict[str, Sequence[Server]] = {**users.SERVICES, **users.TOOLS, **users.THESIS}
        own[users.REDIS_ADMINISTRATOR] = ("redis",)
        own[users.HEALTH] = SERVERS
        own |= {users.PEER: SERVERS} if self._plan.copies else {}
        own |= dict.fromkeys(self._plan.unrestricted, ("mqtt", "zenoh"))
        self._set_users(_shut_out(own, self._files, self.credentials) | self._not_yet_admitted(robots, nodes))
        self._write_rights_in_redis()
        self._write_hashes_of_mqtt()
        self._write_access()

    def add_floor(self, site: str, *, robots: Sequence[str] = (), nodes: Sequence[str] = ()) -> None:
        """Admit the services, tools, robots and nodes of a further site to the same servers; those known stay.

        Its users are named `SITE.NAME`, so that none of them can act on another floor. Raises as `make`, after which
        it is called.
        """
        if site not in self.sites:
            self._save(msgspec.structs.replace(self._plan, floors=[*self._plan.floors, site]))
        own = {users.on_floor(site, name): servers for name, servers in {**users.SERVICES, **users.TOOLS}.items()}
        members = ([users.on_floor(site, each) for each in kind] for kind in (robots, nodes))
        self._set_users(_shut_out(own, self._files, self.credentials) | self._not_yet_admitted(*members))
        self._write_access()

    def _not_yet_admitted(self, robots: Sequence[str], nodes: Sequence[str]) -> dict[str, Sequence[Server]]:
        self._members.require_different_ids(robots, nodes)
        for member in (*robots, *nodes):
            self._members.require_free_name(member)
        # The credentials of robots and nodes need not stay here.
        handed_out: dict[str, Sequence[Server]] = dict.fromkeys(robots, ("zenoh",))
        handed_out |= dict.fromkeys(nodes, ("mqtt",))
        known = self.users()
        return {user: servers for user, servers in handed_out.items() if user not in known}

    @property
    def _files(self) -> ServerFiles:
        return ServerFiles(self._folder, self._plan.mode)

    @property
    def _members(self) -> Members:
        return Members(self._files, unrestricted=self._plan.unrestricted, devices=self._plan.devices)

    @property
    def directory(self) -> Path:
        """The folder."""
        return self._folder

    @property
    def sites(self) -> list[str]:
        """The site for which they were made, then its further floors, in the order in which they were added."""
        return [self._plan.site, *self._plan.floors]

    def user_on(self, site: str, name: str) -> str:
        """Return how the servers call a robot or node of one of `sites`; raises `SecurityError` for another site."""
        if site not in self.sites:
            raise SecurityError(
                f"{self._folder} has the credentials of {', '.join(self.sites)}, not of {site}: name another folder, "
                "or let its fog node serve that site first (fognav up --site)"
            )
        return name if site == self._plan.site else users.on_floor(site, name)

    def users(self) -> set[str]:
        """Return everybody whom a server admits."""
        return {user for program in _PROGRAM_OF.values() for user in self._files.members(program)}

    def credentials(self, user: str) -> Path:
        """Return the file of a user's credentials."""
        floor, name = users.of_floor(user)
        return self._folder / CREDENTIALS / floor / f"{name}.toml"

    def folder(self, program: str) -> Path:
        """Return the folder of one of `PROGRAMS`."""
        return self._files.folder(program)

    @property
    def hosts(self) -> list[str]:
        """The names and addresses for which the servers' certificates are."""
        return list(self._plan.hosts)

    @property
    def authority(self) -> Authority:
        """The certificate authority; raises `AuthorityError`."""
        return Authority.open(self._folder / AUTHORITY)

    def add_robot(self, robot: str) -> Path:
        """Let a robot in, or give it a new password; return its credentials. Raises `SecurityError`."""
        self._members.require_different_ids([robot], [])
        return self._add(robot, ("zenoh",))

    def add_node(self, node: str) -> Path:
        """Let a sensor node in, or give it a new password; return its credentials. Raises `SecurityError`."""
        self._members.require_different_ids([], [node])
        return self._add(node, ("mqtt",))

    def add_device(self, device: str, topics: Sequence[str]) -> Path:
        """Let a sensor or gateway of others use these MQTT topics (wildcards below the first level) and no other.

        One that is known gets a new password and these topics. Returns its credentials. Raises `SecurityError`.
        """
        require_own_topics(device, topics)
        self._members.require_free_name(device)
        if device in self.users() - set(self._plan.devices):
            raise SecurityError(f"{device} is a robot or node already: give the device another name")
        self._save(msgspec.structs.replace(self._plan, devices={**self._plan.devices, device: list(topics)}))
        return self._add(device, ("mqtt",))

    def remove(self, user: str) -> bool:
        """Refuse a robot, node or device from now on, once the servers have read their lists again.

        Returns whether there was one. Raises `SecurityError` for a part of Fognav.
        """
        self._members.require_free_name(user)
        found = False
        for program in _PROGRAM_OF.values():
            lines = self._files.lines(program)
            kept = [line for line in lines if user_of(line) != user]
            found |= len(kept) < len(lines)
            self._files.write_lines(program, kept)
        self.credentials(user).unlink(missing_ok=True)
        self._save(
            msgspec.structs.replace(
                self._plan, devices={name: topics for name, topics in self._plan.devices.items() if name != user}
            )
        )
        self._write_access()
        return found

    def renew(self, hosts: Sequence[str] | None = None, *, only_due: bool) -> list[str]:
        """Issue new certificates for the servers, all or those that expire soon; return whose.

        `hosts`: those of before, if none are given. Raises `AuthorityError`.
        """
        authority, renewed, now = self.authority, [], _now()
        hosts = list(dict.fromkeys([*(self._plan.hosts if hosts is None else hosts), BROKER_NAME]))
        for program in PROGRAMS:
            file = self.folder(program) / CERTIFICATE
            # Near the authority's own end a new one would be valid no longer, and each look would issue another.
            if (
                only_due
                and file.exists()
                and expiry(file) > min(now + _RENEW_BEFORE, authority.lasts_until(now) - _DAY)
            ):
                continue
            issued = authority.issue(program, hosts, now=now)
            self._files.write(program, KEY, issued.key.decode())
            self._files.write(program, CERTIFICATE, issued.chain.decode())
            renewed.append(program)
        self._save(msgspec.structs.replace(self._plan, hosts=hosts))
        return renewed

    def _save(self, plan: _Plan) -> None:
        self._plan = plan
        atomic_write(self._folder / _PLAN, msgspec.json.format(msgspec.json.encode(plan)), mode=PRIVATE)

    def expiries(self) -> dict[str, dt.datetime]:
        """Return when the authority and each server's certificate expire; raises `AuthorityError`."""
        found = {"authority": self.authority.expires}
        return found | {program: expiry(self.folder(program) / CERTIFICATE) for program in PROGRAMS}

    def expiring(self) -> list[str]:
        """Return which of `expiries` are to be renewed. Raises as `expiries`."""
        soon = _now() + _RENEW_BEFORE
        return [name for name, until in self.expiries().items() if until < soon]

    def trust_again(self) -> list[Path]:
        """Write into all credentials here which authorities to trust now; return the files. Raises as `make`."""
        changed = []
        for file in sorted((self._folder / CREDENTIALS).rglob("*.toml")):
            known = Credentials.read(file)
            trusted = self.authority.trusted
            text = to_toml(known.user, authority=trusted, passwords=known.passwords, token=known.token)
            atomic_write(file, text.encode(), mode=stat.S_IMODE(file.stat().st_mode))
            changed.append(file)
        return changed

    def _add(self, user: str, servers: Sequence[Server]) -> Path:
        self._members.require_free_name(user)
        self._set_users({user: servers}, anew=True)
        self._write_access()
        return self.credentials(user)

    def _set_users(self, added: Mapping[str, Sequence[Server]], *, anew: bool = False) -> None:
        """Admit these users to these servers; with `anew`, or where none are here, they get new passwords."""
        trusted = self.authority.trusted
        known = {user: {} if anew else _passwords(self.credentials(user)) for user in added}
        passwords: dict[str, dict[Server, str]] = {
            user: {server: known[user].get(server) or users.new_password() for server in servers}
            for user, servers in added.items()
        }
        for server, program in _PROGRAM_OF.items():
            new = [
                users.line(server, user, own[server], self._plan.site)
                for user, own in passwords.items()
                if server in own
            ]
            replaced = {user_of(each) for each in new}
            if new:
                kept = [line for line in self._files.lines(program) if user_of(line) not in replaced]
                self._files.write_lines(program, [*kept, *new])
        # Last: whatever is cut short before is done again by the next `make`.
        for user, own in passwords.items():
            file = self.credentials(user)
            file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            atomic_write(file, to_toml(user, authority=trusted, passwords=own).encode(), mode=PRIVATE)

    def _write_rights_in_redis(self) -> None:
        """Write what this version's services may do in Redis, in whose list rights and passwords are one line."""
        lines = [users.REDIS_NOBODY]
        for line in self._files.lines("redis"):
            if (user := user_of(line)) == ANYBODY:
                continue
            password = _passwords(self.credentials(user)).get("redis")
            lines.append(line if password is None else users.line("redis", user, password, self._plan.site))
        self._files.write_lines("redis", lines)

    def _write_hashes_of_mqtt(self) -> None:
        """Replace hashes of other versions, which take longer to check, where the passwords are here."""
        lines = self._files.lines("mosquitto")
        passwords = {
            line: password
            for line in lines
            if not users.has_mqtt_cost(line)
            and (password := _passwords(self.credentials(user_of(line))).get("mqtt")) is not None
        }
        if passwords:
            renewed = [users.mqtt_line(user_of(line), passwords[line]) if line in passwords else line for line in lines]
            self._files.write_lines("mosquitto", renewed)

    def _write_access(self) -> None:
        """Write what each user may do; robots and nodes are the users who have no role."""
        plan = self._plan
        nodes = {floor: self._members.of("mosquitto", floor) for floor in plan.floors}
        robots = {floor: self._members.of("zenoh", floor) for floor in plan.floors}
        peers = (users.PEER,) if plan.copies else ()
        unrestricted = (*plan.unrestricted, *peers)
        access = mqtt_acl(plan.site, unrestricted=unrestricted, floors=nodes, devices=plan.devices)
        self._files.write("mosquitto", ACCESS, access)
        own = self._members.of("zenoh", "")
        access = zenoh_acl(plan.site, own, unrestricted=unrestricted, floors=robots, meshed=plan.copies)
        self._files.write("zenoh", f"{ACCESS}.json5", access)


def _read_plan(folder: Path) -> _Plan:
    return msgspec.json.decode((folder / _PLAN).read_bytes(), type=_Plan)


def _shut_out(
    own: Mapping[str, Sequence[Server]], files: ServerFiles, file_of: Callable[[str], Path]
) -> dict[str, Sequence[Server]]:
    """Return who of these lacks a password, or a place in a server's list.

    Another version may have made the credentials that are there, and an older backup the lists.
    """
    admitted = {server: set(files.members(program)) for server, program in _PROGRAM_OF.items()}
    return {
        user: servers
        for user, servers in own.items()
        if not set(servers) <= set(_passwords(file_of(user))) or any(user not in admitted[each] for each in servers)
    }


def _passwords(file: Path) -> Mapping[Server, str]:
    return Credentials.read(file).passwords if file.exists() else {}


def _now() -> dt.datetime:
    return dt.datetime.now(dt.UTC)
