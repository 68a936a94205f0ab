"""Ask for known vulnerabilities of every release that the locks pin; fail if one is found.

Called by `make audit` with pip-audit in the interpreter's own environment. A package that the
service knows nothing of counts as a failure: what was not checked is not safe.
"""

import json
import subprocess
import sys

LOCKS = ("environment.lock", "environment-cuda.lock")


def audit() -> dict[str, list[dict]]:
    """Return pip-audit's report, a list of packages under the key `dependencies`."""
    command = [sys.executable, "-m", "pip_audit", "--format=json", "--progress-spinner=off"]
    command += ["--require-hashes", "--disable-pip", *(f"--requirement={lock}" for lock in LOCKS)]
    run = subprocess.run(command, capture_output=True, text=True)
    try:
        return json.loads(run.stdout)
    except json.JSONDecodeError:
        cause = (run.stderr.strip().splitlines() or [f"exit code {run.returncode}"])[-1]
        sys.exit(f"audit: nothing was checked; pip-audit could not ask its service: {cause}")


def main() -> None:
    """Print one line per vulnerability and per unchecked package, then a verdict."""
    packages = audit()["dependencies"]
    unchecked = [package["name"] for package in packages if "skip_reason" in package]
    if len(unchecked) == len(packages):
        sys.exit("audit: nothing was checked; the vulnerability service could not be reached")
    found = 0
    for package in packages:
        for vulnerability in package.get("vulns", []):
            found += 1
            release = f"{package['name']} {package['version']}"
            fixed = ", ".join(vulnerability["fix_versions"]) or "no release yet"
            print(f"{release}: {vulnerability['id']}, fixed in {fixed}")
    for name in unchecked:
        print(f"{name}: unknown to the service, not checked")
    print(f"{len(packages)} packages, {found} known vulnerabilities, {len(unchecked)} not checked")
    sys.exit(bool(found or unchecked))


if __name__ == "__main__":
    main()
