from setuptools import find_packages, setup

setup(
    name="tcbi_policy",
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    package_data={"tcbi_policy": ["**/*.toml", "**/*.json", "**/*.html", "**/*.css", "**/*.js", "**/*.safetensors"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/tcbi_policy"]),
        ("share/tcbi_policy", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    maintainer="The tcbi developers",
    maintainer_email="tcbi@example.org",
    description="Rewards, training, policy artefacts, the policy node and the retrain action.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "policy_node = tcbi_policy.policy_node:main",
            "retrain_node = tcbi_policy.retrain_node:main",
        ],
    },
)
